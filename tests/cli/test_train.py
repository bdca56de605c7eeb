"""The Hydra tree and the command line of train.py."""

import csv
import json
import math
import os
import runpy
import shutil
import signal
import sys
import time
from functools import cache, partial
from types import SimpleNamespace

import pytest
import torch
from helpers import check_same_checkpoint, make_collector, small_env, table
from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException
from omegaconf import OmegaConf
from processes import leftovers, limit_file_size, limited_file_size, run_script, start_script
from programs import CONF, ROOT, TINY, TINY_HDRQN, call
from safetensors.torch import load_file

from hdrqn_torchrl.algorithms import make_hdrqn, make_v3
from hdrqn_torchrl.cli import train, training
from hdrqn_torchrl.cli.configuration import resolved
from hdrqn_torchrl.cli.resuming import Plan
from hdrqn_torchrl.learning import Learner, LearnerSettings
from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.runs.interruption import Interrupted, StopRequest
from hdrqn_torchrl.runs.logging import CSVLog
from hdrqn_torchrl.runs.persistence.durable import verify
from hdrqn_torchrl.runs.persistence.folder import locked
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.building import build, build_algorithm
from hdrqn_torchrl.runs.settings.reading import read_config

SUMMARY = (
    "return_mean", "success_rate", "in_order_rate", "steps_mean", "episodes", "frames", "updates", "wall_seconds",
    "processor_seconds", "ceiling",
)  # fmt: skip


def choices(group):
    files = [path for path in (CONF / group).rglob("*.yaml") if path.parent.name != "learner"]  # parts of algorithms
    return sorted(str(path.relative_to(CONF / group).with_suffix("")) for path in files)


def configure(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=list(overrides))


@cache
def usual():
    return configure()


COMBINATIONS = sorted(  # four_rooms is gridworld with other walls, and "paper" is read as "compact" is
    {(env, algo, "compact") for env in choices("env") for algo in choices("algo") if env != "four_rooms"}
    | {(env, "v2", network) for env in choices("env") for network in choices("network")}
    | {("gridworld", algo, network) for algo in choices("algo") for network in choices("network")}
)


class TestTree:
    @pytest.mark.parametrize(("env", "algo", "network"), COMBINATIONS)
    def test_combinations_compose_build_and_collect(self, env, algo, network):
        own = ["env.id=gym_toys:Counter-v0", "env.subgoals=gym_toys.Milestones"] if env == "gym" else []
        config = configure(f"env={env}", f"algo={algo}", f"network={network}", "env.num_envs=2", *own)
        config.network.hidden_size = 8
        settings = resolved(config)
        train.check(settings)
        base, algorithm = build_algorithm(settings, {"seed": 0}, settings.allowed_targets)
        assert set(algorithm.explorations) in ({"flat"}, {"sub", "meta"})
        assert set(algorithm.learners) == ({"joint"} if algo == "v3" else set(algorithm.explorations))
        batch = next(iter(make_collector(algorithm, base, 2)))
        assert batch.shape == (2, 2)
        for learner in algorithm.learners.values():
            learner.store(batch)

    @pytest.mark.parametrize("experiment", choices("experiment"))
    def test_every_experiment_composes_and_builds(self, experiment):
        config = configure(f"experiment={experiment}")
        assert config != usual()
        settings = resolved(config)
        train.check(settings)
        assert build_algorithm(settings, {"num_envs": 2})[1].learners

    def test_the_command_line_wins_over_an_experiment(self):
        assert configure("experiment=gridworld").total_frames != usual().total_frames
        config = configure("experiment=gridworld", "total_frames=77", "algo.gamma=0.5")
        assert (config.total_frames, config.algo.gamma) == (77, 0.5)

    @pytest.mark.parametrize("logger", ["csv", "tensorboard"])  # the others are extras: tests/test_logging.py
    def test_every_logger_builds(self, logger, tmp_path):
        settings = resolved(configure(f"logger={logger}")).logger["loggers"]
        loggers = [build(each, tmp_path, place="logger.loggers[0]") for each in settings]
        assert all(hasattr(each, "log_scalar") for each in loggers)

    def test_the_levels_are_configured_separately(self):
        config = configure("algo=v2", "algo.sub.slice_len=3", "algo.meta.slice_len=2", "algo.sub_exploration.end=0.3")
        _, algorithm = build_algorithm(resolved(config), {"num_envs": 2})
        assert [learner.settings.slice_len for learner in algorithm.learners.values()] == [3, 2]
        assert algorithm.explorations["sub"].end == 0.3 != algorithm.explorations["meta"].end

    @pytest.mark.parametrize("place", ["", "evaluation:\n  "], ids=["top", "evaluation"])
    def test_the_schema_refuses_a_typo_in_a_file(self, tmp_path, place):
        """A file that is merged into the top level, as an experiment is."""
        (tmp_path / "extra").mkdir()
        (tmp_path / "extra" / "typo.yaml").write_text(f"# @package _global_\n{place}total_frams: 5\n")
        search = f"hydra.searchpath=[file://{tmp_path}]"
        with pytest.raises(ConfigCompositionException):
            configure(search, "+extra=typo")


class TestMessages:
    """Wrong settings are reported by their full names before anything is trained."""

    @pytest.fixture
    def run(self, tmp_path, monkeypatch, capsys):
        def run(*arguments):
            quiet = [f"hydra.run.dir={tmp_path / 'run'}", "hydra/job_logging=disabled", "hydra/hydra_logging=disabled"]
            monkeypatch.setattr(sys, "argv", ["train.py", *quiet, *TINY, *arguments])
            with pytest.raises(SystemExit) as stop:
                runpy.run_path(str(ROOT / "train.py"), run_name="__main__")
            code = stop.value.code
            assert code not in (0, None)
            assert not (tmp_path / "run" / "metrics.csv").exists()
            told = capsys.readouterr().err.splitlines() + str(code).splitlines()
            return "\n".join(line for line in told if "with overrides" not in line)  # which repeats the command

        return run

    @pytest.mark.parametrize(
        ("argument", "parts"),
        [
            ("env.view=4", ("env.view must be an odd number", "got 4")),
            ("env.num_goals=0", ("env.num_goals must be >= 1", "got 0")),
            ("env.num_envs=0", ("env.num_envs must be >= 1", "got 0")),
            ("env.layout=maze", ("env.layout must be one of", "'maze'")),
            ("algo.sub.slice_len=0", ("algo.sub.slice_len must be >= 1", "got 0")),
            ("algo.meta.tau=2", ("algo.meta.tau must be in (0, 1]", "got 2")),
            ("algo.gamma=1.5", ("gamma must lie in [0, 1]", "got 1.5")),
            ("algo.meta_input=all", ("algo.meta_input must be one of", "'all'")),
            ("algo.sub_exploration.start=2", ("algo.sub_exploration.start must be an epsilon in [0, 1]", "got 2")),
            ("network.hidden_size=0", ("hidden_size must be >= 1", "got 0")),
            ("total_frames=0", ("total_frames must be >= 1", "got 0")),
            ("steps_per_batch=1", ("steps_per_batch must be >= 2", "got 1")),
            ("evaluation.episodes=0", ("evaluation.episodes must be >= 1", "got 0")),
            ("device=tpu", ("device must be auto, cpu or cuda", "'tpu'")),
        ],
    )
    def test_a_wrong_value_is_reported_with_its_rule(self, run, argument, parts):
        message = run(argument)
        for part in parts:
            assert part in message, message

    def test_options_of_hydra_may_stand_between_settings(self, run, tmp_path):
        (tmp_path / "my_conf" / "env").mkdir(parents=True)
        (tmp_path / "my_conf" / "env" / "mine.yaml").write_text("defaults:\n  - gridworld\n  - _self_\nview: 4\n")
        told = run("env=mine", "--config-dir", str(tmp_path / "my_conf"), "env.max_steps=6")
        assert "env.view must be an odd number" in told

    @pytest.mark.parametrize(
        ("argument", "part"),
        [
            ("algo=v9", "algo/v9"),
            ("env=maze", "env/maze"),
            ("env.veiw=3", "env.veiw"),
            ("+env.veiw=3", "env.veiw must be left out, got 3"),
            ("algo.sub.slice_length=3", "algo.sub.slice_length"),
            ("+algo.sub.slice_length=3", "algo.sub.slice_length must be left out, got 3"),
            ("total_frams=5", "total_frams"),
            ("+total_frams=5", "total_frams"),
            ("+evaluation.episods=5", "episods"),
            ("total_frames=many", "total_frames"),
        ],
    )
    def test_an_unknown_name_is_named(self, run, argument, part):
        assert part in run(argument)


def test_a_training_that_ends_before_a_learner_begins_is_warned_of():
    agent = make_hdrqn(small_env(), compact_network(8, (8,)), meta=LearnerSettings(warmup_frames=9_000))
    assert training.late_learners(agent, 9_001) == []
    assert training.late_learners(agent, 9_000) == [
        "warning: total_frames=9,000 must be above warmup_frames=9,000 for the learner 'meta' to learn anything; use "
        "more frames or a shorter warmup"
    ]


def test_worlds_of_which_most_of_a_training_sees_the_first_sequence_only_are_warned_of():
    env = small_env(64, max_steps=10)
    agent = make_v3(
        env,
        compact_network(8, (8,)),
        learner=LearnerSettings(slice_len=10, sampling="episode_starts", warmup_frames=100),
    )
    assert agent.learners["joint"].first_update_at == 640 + 64 * agent.learners["joint"].loss.lookahead
    first = agent.learners["joint"].first_update_at
    assert training.late_learners(agent, 4 * first) == []
    (sentence,) = training.late_learners(agent, 4 * first - 1)
    assert f"learns nothing in the first {first:,} frames" in sentence and "use fewer worlds or more frames" in sentence


def test_a_stop_request_cuts_evaluations_off(tmp_path):
    settings = resolved(configure("env.num_envs=2", "evaluation.num_envs=2", "logger=csv"))
    with StopRequest() as stop:
        trainer, *_ = training.build_run(Plan(tmp_path, settings, {}, resumed=False), stop)
        assert trainer.evaluate()["episodes"] >= 2
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(Interrupted):
            trainer.evaluate()
    trainer.collector.shutdown()


@pytest.mark.parametrize("question", [["--help"], ["--cfg", "job"], ["--cfg", "job", "algo=drqn"]], ids=" ".join)
def test_questions_are_answered_without_loading_torch(tmp_path, question):
    done = call(tmp_path, "-X", "importtime", str(ROOT / "train.py"), *question)
    assert done.returncode == 0, done.stderr
    assert "total_frames" in done.stdout
    loaded = {line.rpartition("|")[2].strip().partition(".")[0] for line in done.stderr.splitlines()}
    assert "hydra" in loaded and not loaded & {"torch", "torchrl", "tensordict", "numpy", "matplotlib"}
    assert not list(tmp_path.iterdir())


def check_run_folder(folder, *, frames):
    names = {path.name for path in folder.iterdir()}
    assert {"config.yaml", "run.json", "metrics.csv", "summary.json", "curves.png", "checkpoints"} <= names
    assert not {name for name in names if name.endswith((".partial", ".txt"))}
    summary = json.loads((folder / "summary.json").read_text())
    assert set(SUMMARY) <= set(summary)
    assert all(isinstance(summary[key], (int, float)) and math.isfinite(summary[key]) for key in SUMMARY)
    assert summary["frames"] == frames and summary["updates"] > 0 and summary["episodes"] == 8
    with (folder / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert (int(rows[0]["frames"]), int(rows[-1]["frames"])) == (0, frames)
    assert rows[-1]["greedy/return"] and rows[-1]["behaviour/return"]
    checkpoints = sorted(path.name for path in (folder / "checkpoints").iterdir())
    assert checkpoints[-1] == f"checkpoint-{frames:012d}" and len(checkpoints) <= 3
    return summary


def test_a_run_leaves_a_complete_folder(tmp_path):
    script = str(ROOT / "train.py")
    done = call(tmp_path, script, "env=four_rooms", "algo=v2", *TINY, *TINY_HDRQN, "seed=3", "hydra.run.dir=run")
    assert done.returncode == 0, done.stderr
    summary = check_run_folder(tmp_path / "run", frames=2_048)  # whole batches of 8 x 8 steps
    printed = json.loads(done.stdout.strip().splitlines()[-1])
    assert {key: printed[key] for key in SUMMARY} == {key: summary[key] for key in SUMMARY}
    config = OmegaConf.load(tmp_path / "run" / "config.yaml")
    assert (config.seed, config.env.layout, config.env.num_envs, config.algo.version) == (3, "four_rooms", 8, "v2")
    assert list((tmp_path / "run" / "tensorboard").rglob("events*"))
    assert not [line for line in done.stderr.splitlines() if "Traceback" in line]


def test_a_sweep_runs_one_job_after_the_other(tmp_path):
    tiny = [setting for setting in TINY if "total_frames" not in setting]
    sweep = ["-m", "algo=hdqn,v1", "seed=5", "hydra.sweep.dir=sweep", "logger=csv", "total_frames=600"]
    code, _, told = run_script(tmp_path, *sweep, *tiny, *TINY_HDRQN)
    assert code == 0, told
    folders = sorted(path for path in (tmp_path / "sweep").iterdir() if path.is_dir())
    assert [folder.name for folder in folders] == ["0-gridworld-hdqn-seed5", "1-gridworld-v1-seed5"]
    for folder, recurrent in zip(folders, (False, True), strict=True):
        check_run_folder(folder, frames=640)
        assert OmegaConf.load(folder / "config.yaml").algo.recurrent == recurrent


SHORT = [
    "device=cpu", "env.num_envs=16", "total_frames=2048", "log_frames=256", "evaluation.num_envs=8",
    "evaluation.episodes=8", "evaluation.interval_frames=100_000", "evaluation.final_episodes=8",
    "network.hidden_size=8", "network.widths=[8]", "logger=csv", "checkpoint.interval_frames=512", *TINY_HDRQN,
]  # fmt: skip


def wait_for_row(folder, frames, process):
    """Until the only run below ``folder`` has a log point at or after ``frames``; returns its folder."""
    deadline = time.monotonic() + 100
    while time.monotonic() < deadline and process.is_alive():
        for metrics in [*folder.glob("*/metrics.csv"), *folder.glob("*/*/*/metrics.csv")]:  # checkpoints come and go
            if any(int(row["frames"]) >= frames for row in table(metrics.parent)):
                return metrics.parent
        time.sleep(0.01)
    raise AssertionError((folder / "stderr.txt").read_text())


def stop(process, number):
    os.kill(process.pid, number)
    process.join(60)
    return process.exitcode


class TestStoppingAndResuming:
    def test_a_run_that_was_stopped_twice_is_the_same_as_one_that_was_not(self, tmp_path):
        """By SIGTERM and by Ctrl-C; resumed by ``resume=FOLDER`` and by the same command with ``resume=auto``."""
        plain, same = tmp_path / "plain", tmp_path / "same"
        for folder in (plain, same):
            folder.mkdir()
        code, _, told = run_script(plain, *SHORT, "hydra.run.dir=run")
        assert code == 0, told

        process = start_script(same, *SHORT, "resume=auto")
        run = wait_for_row(same, 512, process)
        assert stop(process, signal.SIGTERM) == 143
        told = (same / "stderr.txt").read_text()
        assert (
            f"train.py resume={run}` goes on" in told
            and "stopped by SIGTERM; `python " in told
            and "Traceback" not in told
        )
        self.check_stopped(run, before=2048)

        process = start_script(same, f"resume={run.relative_to(same)}", "hydra.job.chdir=true")  # which moves no path
        wait_for_row(same, 1280, process)
        assert stop(process, signal.SIGINT) == 130
        assert "stopped by SIGINT; " in (same / "stderr.txt").read_text()
        self.check_stopped(run, before=2048)

        code, printed, told = run_script(same, *SHORT, "resume=auto", "hydra.job.chdir=true")
        assert code == 0, told
        assert json.loads(printed)["run"] == str(run.relative_to(same)) and len(list(same.rglob("config.yaml"))) == 1
        check_same_checkpoint(run, plain / "run")
        assert table(run) == table(plain / "run") and len(table(run)) == 9
        check_run_folder(run, frames=2_048)
        summaries = [json.loads((folder / "summary.json").read_text()) for folder in (run, plain / "run")]
        clock = {"wall_seconds": 0, "processor_seconds": 0}
        assert summaries[0] | clock == summaries[1] | clock

    def check_stopped(self, run, *, before):
        assert {"config.yaml", "run.json", "metrics.csv", "checkpoints"} <= {path.name for path in run.iterdir()}
        assert not (run / "summary.json").exists() and not (run / "error.txt").exists()
        assert 0 < max(int(path.name[-12:]) for path in (run / "checkpoints").iterdir()) < before
        assert not list((run / "checkpoints").glob(".*"))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder above a short finished run, ``run``, with checkpoints at 512 and 1024 frames."""
    folder = tmp_path_factory.mktemp("finished")
    code, _, told = run_script(folder, *SHORT, "total_frames=1024", "hydra.run.dir=run")
    assert code == 0, told
    return folder


@pytest.fixture
def a_run(finished, tmp_path):
    """A copy of the finished run to work on."""
    return shutil.copytree(finished, tmp_path / "a") / "run"


def snapshot(folder):
    """All files with their contents, but for the lock."""
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file() and path.name != ".lock"}


class TestGoingOnWithAFinishedRun:
    def test_a_finished_run_can_go_on_for_more_frames(self, a_run):
        process = start_script(a_run.parent, "resume=run", "total_frames=4096")
        wait_for_row(a_run.parent, 1280, process)
        assert not (a_run / "summary.json").exists() and not (a_run / "curves.png").exists()  # it is unfinished again
        assert stop(process, signal.SIGTERM) == 143
        assert OmegaConf.load(a_run / "config.yaml").total_frames == 4096

    def test_resuming_a_finished_run_trains_no_more(self, a_run):
        rows, before = table(a_run), snapshot(a_run / "checkpoints")
        code, _, told = run_script(a_run.parent, "resume=run")
        assert code == 0, told
        assert table(a_run) == rows and snapshot(a_run / "checkpoints") == before
        check_run_folder(a_run, frames=1_024)

    def test_a_finished_run_can_go_on_from_an_older_checkpoint(self, a_run, finished):
        code, _, told = run_script(
            a_run.parent, "resume=run/checkpoints/checkpoint-000000000512", "resume_override=true"
        )
        assert code == 0, told
        assert table(a_run) == table(finished / "run")
        check_same_checkpoint(a_run, finished / "run")


class TestBeginningWithOtherWeights:
    def begin(self, folder, *arguments):
        return run_script(folder, *SHORT, "seed=7", "env.max_steps=20", "hydra.run.dir=new", *arguments)

    def weights(self, path):
        return load_file(next(path.glob("components/*-policy")) / "tensors.safetensors")

    def test_a_run_can_begin_with_the_weights_of_one_on_another_task(self, a_run):
        slow = ["total_frames=512", "algo.sub.learning_rate=1e-12", "algo.meta.learning_rate=1e-12"]
        slow += ["algo.sub.learning_rate_end=null", "algo.meta.learning_rate_end=null"]
        code, _, told = self.begin(a_run.parent, "init_from=run", "init_checkpoint=last", *slow)
        assert code == 0, told
        source, new = a_run / "checkpoints" / "checkpoint-000000001024", a_run.parent / "new"
        before, after = self.weights(source), self.weights(new / "checkpoints" / "checkpoint-000000000512")
        assert (after["sub_controller.exploration.frames"], before["sub_controller.exploration.frames"]) == (512, 1024)
        for name in set(before) - {each for each in before if "exploration" in each}:
            assert torch.allclose(before[name], after[name], atol=1e-6), name
        assert json.loads((new / "run.json").read_text())["init_from"] == str(source.relative_to(a_run.parent))
        assert table(new)[0]["updates"] == "0" and OmegaConf.load(new / "config.yaml").init_from == "run"
        shutil.rmtree(a_run)  # a run that has begun does not need it any more
        code, _, told = run_script(a_run.parent, "resume=new", "total_frames=640")
        assert code == 0, told

    def test_initial_weights_that_do_not_fit_are_refused(self, a_run):
        code, _, told = self.begin(a_run.parent, "init_from=run", "env.view=3")
        assert code == 1 and "Traceback" not in told
        assert "error: init_from must hold the weights of an agent with the same networks, got others: " in told


class TestWhatIsLeftAlone:
    """Commands that must not touch a run, and say why."""

    def refused(self, folder, *arguments):
        code, printed, told = run_script(folder, *arguments)
        assert code == 1 and "Traceback" not in told and printed == ""
        return told.strip().splitlines()

    def test_a_new_run_in_the_folder_of_another_is_refused(self, a_run):
        before = snapshot(a_run)
        told = self.refused(a_run.parent, *SHORT, "hydra.run.dir=run")
        assert told[-1].startswith("error: ") and "already holds a run, which would be overwritten" in told[-1]
        assert snapshot(a_run) == before

    @pytest.mark.parametrize(
        ("name", "remedy"), [("summary.json", "in another folder"), ("weights.safetensors", "by init_from=run,")]
    )
    def test_results_and_weights_without_checkpoints_are_not_overwritten(self, a_run, name, remedy):
        shutil.rmtree(a_run / "checkpoints")
        if name != "summary.json":
            (a_run / "summary.json").rename(a_run / name)
        before = snapshot(a_run)
        told = self.refused(a_run.parent, "resume=run")
        assert "resume must name a run that has checkpoints" in told[-1] and remedy in told[-1]
        assert snapshot(a_run) == before

    def test_measurements_of_a_run_that_had_checkpoints_are_not_overwritten(self, a_run):
        shutil.rmtree(a_run / "checkpoints")
        (a_run / "summary.json").unlink()
        with (a_run / "metrics.csv").open("a") as file:
            file.write("3000000,")
        before = snapshot(a_run)
        told = self.refused(a_run.parent, "resume=run")
        assert "its metrics.csv would be void" in told[-1]
        assert snapshot(a_run) == before

    def test_a_new_run_in_a_folder_with_files_of_the_same_names_is_refused(self, tmp_path):
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / "summary.json").write_text("mine")
        told = self.refused(tmp_path, *SHORT, "hydra.run.dir=run")
        assert "holds no run, but summary.json, which would be overwritten" in told[-1]
        assert (tmp_path / "run" / "summary.json").read_text() == "mine"

    def test_a_run_that_another_process_has_begun_meanwhile_is_refused(self, a_run):
        settings = read_config(a_run)
        before = snapshot(a_run)
        with pytest.raises(SettingsError, match="already holds a run"):
            training.begin(Plan(a_run, settings, {}, resumed=False))
        assert snapshot(a_run) == before

    def test_resuming_an_older_checkpoint_is_refused_while_there_are_newer_ones(self, a_run):
        before = snapshot(a_run)
        told = self.refused(a_run.parent, "resume=run/checkpoints/checkpoint-000000000512")
        assert "must name a run's newest checkpoint" in told[-1] and "resume_override=true" in told[-1]
        assert snapshot(a_run) == before

    def test_resuming_with_other_settings_is_refused(self, a_run):
        before = snapshot(a_run)
        told = self.refused(a_run.parent, "resume=run", "seed=5", "algo.sub.tau=0.5")
        assert told[-4:-1] == [
            "error: settings must be those of the run that is resumed, and differ from run:",
            "  algo.sub.tau: 0.003 -> 0.5",
            "  seed: 0 -> 5",
        ]
        assert snapshot(a_run) == before

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ("network.hidden_size=16", "checkpoint-000000001024 does not fit; it must be loaded with the settings"),
            ("env.view=4", "env.view must be an odd number"),
        ],
    )
    def test_settings_that_do_not_fit_are_refused_in_spite_of_resume_override(self, a_run, change, message):
        before = snapshot(a_run)
        told = self.refused(a_run.parent, "resume=run", change, "resume_override=true")
        assert any(line.startswith("error: ") and message in line for line in told)
        assert snapshot(a_run) == before  # no error.txt either: the run has not failed

    def test_a_run_that_is_being_trained_is_left_alone(self, a_run):
        before = snapshot(a_run)
        with locked(a_run):
            told = self.refused(a_run.parent, "resume=run")
            assert f"run is in use: process {os.getpid()} on " in told[-1]
            assert told[-1].endswith("is training there; wait or stop it.")
            empty = a_run.parent / "new"
            with locked(empty):
                told = self.refused(a_run.parent, *SHORT, "hydra.run.dir=new")
            assert "new is in use" in told[-1] and [path.name for path in empty.iterdir()] == [".lock"]
        assert snapshot(a_run) == before

    def test_a_run_whose_checkpoints_are_all_damaged_is_left_alone(self, a_run):
        for manifest in a_run.rglob("manifest.json"):
            manifest.write_text("{}")
        before = snapshot(a_run)
        told = self.refused(a_run.parent, "resume=run")
        assert any("checkpoint-000000000512 is damaged: manifest.json is not what was written" in line for line in told)
        assert "error: no checkpoint in" in told[-1] and "can be loaded; remove that folder to start" in told[-1]
        assert snapshot(a_run) == before

    def test_a_malicious_run_is_left_alone(self, a_run):
        text = (a_run / "config.yaml").read_text()
        (a_run / "config.yaml").write_text(text.replace("hdrqn_torchrl.modules.compact_network", "os.makedirs"))
        before = snapshot(a_run)
        told = self.refused(a_run.parent, "resume=run")
        assert (
            "network._target_ must be one of the builders that this program trusts there, got 'os.makedirs'" in told[-1]
        )
        assert snapshot(a_run) == before


class TestFailures:
    def test_a_wrong_setting_leaves_a_note_in_its_own_new_folder(self, tmp_path):
        code, _, told = run_script(tmp_path, *SHORT, "hydra.run.dir=run", "env.view=4")
        assert code == 1 and "error: env.view must be an odd number" in told and "Traceback" not in told
        assert "view must be an odd number" in (tmp_path / "run" / "error.txt").read_text()
        assert {path.name for path in (tmp_path / "run").iterdir()} == {".lock", "error.txt"}  # which is no run
        process = start_script(tmp_path, *SHORT, "hydra.run.dir=run")
        wait_for_row(tmp_path, 0, process)
        assert not (tmp_path / "run" / "error.txt").exists()
        assert stop(process, signal.SIGINT) == 130

    def test_a_run_that_was_killed_before_its_first_checkpoint_starts_again(self, a_run, finished):
        shutil.rmtree(a_run / "checkpoints")
        (a_run / "summary.json").unlink()
        rows = (a_run / "metrics.csv").read_text().splitlines(keepends=True)
        (a_run / "metrics.csv").write_text("".join(rows[:2]))
        (a_run / "metrics.partial").write_text("half")
        code, _, told = run_script(a_run.parent, "resume=run")
        assert code == 0 and "run has no checkpoint to go on from: it begins anew" in told, told
        assert table(a_run) == table(finished / "run") and not (a_run / "metrics.partial").exists()
        check_same_checkpoint(a_run, finished / "run")

    def test_a_damaged_newest_checkpoint_costs_one_interval(self, a_run, finished):
        newest = a_run / "checkpoints" / "checkpoint-000000001024"
        (policy,) = (newest / "components").glob("*-policy")
        (policy / "tensors.safetensors").write_bytes(b"half")
        code, _, told = run_script(a_run.parent, "resume=run")
        assert code == 0, told
        assert f"checkpoint-000000001024 is damaged: components/{policy.name}/tensors.safetensors is not what" in told
        check_same_checkpoint(a_run, finished / "run")
        assert table(a_run) == table(finished / "run")

    def test_a_kill_between_the_two_renames_of_a_replaced_checkpoint_loses_nothing(self, a_run):
        """Its only checkpoint has no name at that moment; it must not start from scratch."""
        only = a_run / "checkpoints" / "checkpoint-000000001024"
        for path in only.parent.iterdir():
            if path != only:
                shutil.rmtree(path)
        rows, inode = table(a_run), only.stat().st_ino
        only.rename(only.with_name(f".{only.name}.backup-0123"))
        (only.parent / f".{only.name}.stage-0123").mkdir()
        code, _, told = run_script(a_run.parent, "resume=run")
        assert code == 0, told
        assert list(only.parent.iterdir()) == [only] and table(a_run) == rows
        assert only.stat().st_ino == inode  # it was not written again

    def test_a_full_disk_ends_the_training_with_a_message(self, a_run):
        good = a_run / "checkpoints" / "checkpoint-000000001024"
        command, limit = ["resume=run", "total_frames=2048"], partial(limit_file_size, 40_000)
        code, printed, told = run_script(a_run.parent, *command, prepare=limit)
        assert (code, printed) == (1, "") and "Traceback" not in told
        line = told.strip().splitlines()[-1]
        assert line.startswith("error: the checkpoint at step 1536 can't be written to ") and "File too large" in line
        assert f"the last good checkpoint is {good.resolve()}. Make room" in line.replace("run/check", f"{a_run}/check")
        assert "CheckpointError" in (a_run / "error.txt").read_text() and leftovers(a_run) == 0
        verify(good)

    def test_a_full_disk_while_writing_metrics_ends_the_training_with_a_message(self, a_run):
        code, _, told = run_script(a_run.parent, "resume=run", "total_frames=2048", prepare=fill_disk_at_next_row)
        assert code == 1 and "Traceback" not in told
        line = told.strip().splitlines()[-1]
        assert "File too large" in line and "train.py resume=run` goes on from the last checkpoint" in line

    def test_a_nan_ends_the_training_with_a_message(self, a_run):
        code, printed, told = run_script(a_run.parent, "resume=run", "total_frames=2048", prepare=poison_updates)
        assert (code, printed) == (1, "") and "Traceback" not in told
        line = told.strip().splitlines()[-1]
        assert (
            line.startswith("error: sub: the loss became nan in update ") and "training stopped before it could" in line
        )
        assert "the last good checkpoint is " in line and "checkpoint-000000001024" in line
        assert "NonFiniteError" in (a_run / "error.txt").read_text()

    def test_a_run_folder_that_can_not_be_made_is_reported(self, tmp_path):
        (tmp_path / "file").write_text("")
        code, _, told = run_script(tmp_path, *SHORT, "output_root=file")
        assert code == 1 and told.startswith(
            "error: hydra.run.dir (in output_root, unless it is given) must be a folder"
        )
        code, _, told = run_script(tmp_path, *SHORT, "hydra.run.dir=file/run")
        assert code == 1 and "Traceback" not in told
        (line,) = told.strip().splitlines()
        assert line.startswith("error: hydra.run.dir (in output_root, unless it is given) must be a folder that can be")
        assert "Not a directory" in line and "file/run" in line


def fill_disk_at_next_row():
    """The first row of metrics that a process writes does not fit on the disk."""
    write = CSVLog.write

    def write_on_a_full_disk(self, row):
        with limited_file_size(self.path.stat().st_size + 10):
            write(self, row)

    CSVLog.write = write_on_a_full_disk


def poison_updates():
    """From 1280 frames on the loss of a process is NaN."""
    sample = Learner.sample

    def poisoned_sample(self):
        drawn = sample(self)
        if self.frames >= 1280:
            next(self.network.parameters()).data[0] = float("nan")
        return drawn

    Learner.sample = poisoned_sample


def test_a_figure_s_title_names_the_task_by_its_id():
    run = SimpleNamespace(
        choices={"env": "gym", "algo": "drqn"}, config=SimpleNamespace(env={"id": "CartPole-v1"}, seed=3)
    )
    assert training.title_of(run) == "env=gym algo=drqn id=CartPole-v1 seed=3"
