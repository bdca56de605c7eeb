"""The Hydra tree and the command line of train.py."""

import csv
import json
import math
import os
import runpy
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers import make_collector
from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException
from hydra.utils import instantiate
from omegaconf import OmegaConf

import train

ROOT = Path(train.__file__).parent
CONF = ROOT / "conf"
SUMMARY = (
    "return_mean", "success_rate", "in_order_rate", "steps_mean", "episodes", "frames", "updates", "wall_seconds",
    "ceiling",
)  # fmt: skip
TINY = [
    "device=cpu", "env.num_envs=8", "env.max_steps=10", "total_frames=2000", "log_frames=500", "evaluation.num_envs=8",
    "evaluation.episodes=8", "evaluation.interval_frames=1000", "evaluation.final_episodes=8", "network.hidden_size=8",
    "network.widths=[8]",
]  # fmt: skip
TINY_LEVEL = ("batch_size=4", "warmup_frames=200", "frames_per_update=100")
TINY_HDRQN = [f"algo.{level}.{setting}" for level in ("sub", "meta") for setting in TINY_LEVEL]


def choices(group):
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def configure(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=list(overrides))


class TestTree:
    @pytest.mark.parametrize("network", choices("network"))
    @pytest.mark.parametrize("algo", choices("algo"))
    @pytest.mark.parametrize("env", choices("env"))
    def test_every_combination_composes_builds_and_collects(self, env, algo, network):
        config = configure(f"env={env}", f"algo={algo}", f"network={network}", "env.num_envs=2")
        train.check(config)
        config.network.hidden_size = 8
        base = instantiate(config.env, seed=0)
        algorithm = instantiate(config.algo, base, instantiate(config.network))
        assert set(algorithm.learners) == set(algorithm.explorations) != set()
        batch = next(iter(make_collector(algorithm, base, 2)))
        assert batch.shape == (2, 2)
        for learner in algorithm.learners.values():
            learner.store(batch)

    @pytest.mark.parametrize("experiment", choices("experiment"))
    def test_every_experiment_composes_and_builds(self, experiment):
        plain, config = configure(), configure(f"experiment={experiment}")
        assert config != plain
        train.check(config)
        base = instantiate(config.env, num_envs=2)
        assert instantiate(config.algo, base, instantiate(config.network)).learners

    @pytest.mark.parametrize("experiment", choices("experiment"))
    def test_the_command_line_wins_over_an_experiment(self, experiment):
        config = configure(f"experiment={experiment}", "total_frames=77", "algo.gamma=0.5")
        assert (config.total_frames, config.algo.gamma) == (77, 0.5)

    @pytest.mark.parametrize("logger", choices("logger"))
    def test_every_logger_builds(self, logger, tmp_path):
        loggers = [instantiate(each, tmp_path) for each in configure(f"logger={logger}").logger.loggers]
        assert all(hasattr(each, "log_scalar") for each in loggers)

    def test_the_levels_are_configured_apart(self):
        config = configure("algo=v2", "algo.sub.slice_len=3", "algo.meta.slice_len=2", "algo.sub_exploration.end=0.3")
        algorithm = instantiate(config.algo, instantiate(config.env, num_envs=2), instantiate(config.network))
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
    """Wrong settings are told by their full names before anything is trained."""

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
    def test_a_wrong_value_is_told_with_its_rule(self, run, argument, parts):
        message = run(argument)
        for part in parts:
            assert part in message, message

    @pytest.mark.parametrize(
        ("argument", "part"),
        [
            ("algo=v9", "algo/v9"),
            ("env=maze", "env/maze"),
            ("env.veiw=3", "env.veiw"),
            ("+env.veiw=3", "'veiw'"),
            ("algo.sub.slice_length=3", "algo.sub.slice_length"),
            ("+algo.sub.slice_length=3", "'slice_length'"),
            ("total_frams=5", "total_frams"),
            ("+total_frams=5", "total_frams"),
            ("+evaluation.episods=5", "episods"),
            ("total_frames=many", "total_frames"),
        ],
    )
    def test_an_unknown_name_is_named(self, run, argument, part):
        assert part in run(argument)

    def test_a_gpu_that_is_not_there(self):
        with pytest.raises(ValueError, match="device must be cpu or auto"):
            train.pick_device("cuda", has_cuda=False)

    @pytest.mark.parametrize(
        ("name", "has_cuda", "device"), [("auto", True, "cuda"), ("auto", False, "cpu"), ("cpu", True, "cpu")]
    )
    def test_pick_device(self, name, has_cuda, device):
        assert train.pick_device(name, has_cuda) == device


def call(folder, *arguments):
    """Runs train.py in ``folder`` as a process of its own."""
    command = [sys.executable, *arguments]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


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
    assert {"config.yaml", "metrics.csv", "summary.json", "curves.png", "checkpoints"} <= names
    summary = json.loads((folder / "summary.json").read_text())
    assert set(SUMMARY) <= set(summary)
    assert all(isinstance(summary[key], (int, float)) and math.isfinite(summary[key]) for key in SUMMARY)
    assert summary["frames"] == frames and summary["updates"] > 0 and summary["episodes"] == 8
    with (folder / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert (int(rows[0]["frames"]), int(rows[-1]["frames"])) == (0, frames)
    assert rows[-1]["greedy/return"] and rows[-1]["behaviour/return"]
    assert {path.name for path in (folder / "checkpoints").iterdir()} == {"last.safetensors", "best.safetensors"}
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
    script, tiny = str(ROOT / "train.py"), [setting for setting in TINY if "total_frames" not in setting]
    sweep = ["-m", "algo=hdqn,v1", "seed=5", "hydra.sweep.dir=sweep", "logger=csv", "total_frames=600"]
    done = call(tmp_path, script, *sweep, *tiny, *TINY_HDRQN)
    assert done.returncode == 0, done.stderr
    folders = sorted(path for path in (tmp_path / "sweep").iterdir() if path.is_dir())
    assert [folder.name for folder in folders] == ["0-gridworld-hdqn-seed5", "1-gridworld-v1-seed5"]
    for folder, recurrent in zip(folders, (False, True), strict=True):
        check_run_folder(folder, frames=640)
        assert OmegaConf.load(folder / "config.yaml").algo.recurrent == recurrent


@pytest.mark.slow
def test_ctrl_c_keeps_what_there_is(tmp_path):
    endless = [setting for setting in TINY if "total_frames" not in setting]
    command = [
        sys.executable,
        str(ROOT / "train.py"),
        *endless,
        *TINY_HDRQN,
        "hydra.run.dir=run",
        "total_frames=100000000",
    ]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    try:
        metrics = tmp_path / "run" / "metrics.csv"
        for _ in range(1_200):
            if metrics.exists() and len(metrics.read_text().splitlines()) > 3:
                break
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode not in (0, None) and "interrupted" in told
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["frames"] > 0 and (tmp_path / "run" / "checkpoints" / "last.safetensors").exists()
