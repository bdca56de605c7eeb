"""What agents of different makers are asked for, and how their results come together."""

import json
import subprocess
import sys
from math import inf
from pathlib import Path

import numpy as np
import ours
import pytest
import table
import tasks
from arguments import Arguments
from evaluations import Evaluation, append, read, write
from hydra import compose, initialize_config_dir
from ours import OurArguments
from programs import wait_until
from run_folders import CONF

from hdrqn_torchrl.cli.configuration import resolved
from hdrqn_torchrl.runs.settings.building import build_algorithm, build_env

TASK = "MiniGrid-DoorKey-8x8-v0"


def evaluation(frames, success, *, seed=0, agent="v3_flat", bonus=1.0, seconds=None, sampled=None, final=True):
    return Evaluation(
        agent=agent, id=TASK, bonus=bonus, seed=seed, frames=frames, seconds=frames / 50,
        cpu_seconds=seconds or frames / 100, episodes=10, return_mean=success / 2, success_rate=success,
        steps_mean=640 * (1 - success), sampled_success_rate=sampled, final=final,
    )  # fmt: skip


class TestArguments:
    def test_words_become_values(self):
        found = OurArguments.read([f"id={TASK}", "frames=2_000", "bonus=0.5", "levels=2", "runs=a/b"])
        assert (found.frames, found.bonus, found.levels, found.seconds, str(found.runs)) == (2000, 0.5, 2, inf, "a/b")
        assert found.name_of("x") == f"{TASK}-x-bonus0.5-seed0"

    def test_a_shorter_time_limit_is_another_task(self):
        found = OurArguments(id=TASK, max_steps=200)
        assert found.name_of("x") == f"{TASK}-max_steps200-x-bonus0-seed0"
        assert "env.max_steps=200" in ours.settings_of(found)

    @pytest.mark.parametrize(
        ("words", "sentence"),
        [
            (["id=a", "frame=3"], "arguments must be NAME=VALUE with a name in .*, got 'frame=3'"),
            (["id=a", "frames=many"], "frames must be of type int, got 'many'"),
            ([], "id must be given"),
        ],
    )
    def test_wrong_words_end_the_program_with_a_sentence(self, words, sentence):
        with pytest.raises(SystemExit, match=sentence):
            Arguments.read(words)


@pytest.mark.parametrize("name", tasks.GRID_WORLDS)
def test_a_grid_world_is_the_same_for_all_agents(name):
    with initialize_config_dir(CONF, version_base="1.3"):
        config = compose("config", overrides=ours.settings_of(OurArguments(id=name, max_steps=40)))
    assert build_env(resolved(config), {}).settings == tasks.make_task(name, config.env.num_envs, max_steps=40).settings


def test_results_survive_on_disk_and_a_line_that_was_cut_off_does_not(tmp_path):
    path = tmp_path / "new" / "run.jsonl"
    assert read(path) == []
    rows = [evaluation(0, 0.0), evaluation(100, 0.5)]
    for row in rows:
        append(path, row)
    path.write_text(path.read_text() + '{"agent": "v3')
    assert read(path) == rows
    write(path, rows[:1])
    assert read(path) == rows[:1]


class TestOurs:
    @pytest.mark.parametrize(("levels", "bonus"), [(1, 1.0), (2, 0.0)])
    def test_settings_are_those_of_train_py(self, levels, bonus):
        arguments = OurArguments(id=TASK, seed=3, frames=1000, levels=levels, bonus=bonus)
        with initialize_config_dir(CONF, version_base="1.3"):
            config = compose("config", overrides=ours.settings_of(arguments))
        assert (config.env.id, config.seed, config.total_frames) == (TASK, 3, 1000)
        assert (config.algo.levels, config.algo.bonus_reward, config.algo.meta_gamma) == (levels, bonus, 0.99)
        assert (config.evaluation.num_envs, config.evaluation.seed) == (100, 1_000_000)
        pytest.importorskip("minigrid")
        config.env.num_envs = 2
        _, algorithm = build_algorithm(resolved(config))
        assert len(algorithm.levels) == levels

    @pytest.mark.parametrize("levels", [1, 2])
    @pytest.mark.parametrize("task", [TASK, *tasks.GRID_WORLDS, *tasks.LONG_EXPLORATION])
    def test_exploration_is_what_others_are_told(self, task, levels):
        with initialize_config_dir(CONF, version_base="1.3"):
            config = compose("config", overrides=ours.settings_of(OurArguments(id=task, levels=levels)))
        epsilon = config.algo.sub_exploration
        assert tasks.exploration_of(task) == (epsilon.anneal_frames, epsilon.end)

    def test_a_run_folder_becomes_evaluations(self, tmp_path):
        arguments = OurArguments(id=TASK, runs=tmp_path, bonus=1.0)
        arguments.folder.mkdir()
        columns = "frames,wall_seconds,processor_seconds,greedy/return,greedy/success,greedy/steps,greedy/episodes"
        rows = ["0,1.5,1,0.0,0.0,640,100", "10,5.0,4,,,,", "50,90.0,60,0.4,0.5,320,100", "80,150.0,99,0.4,0.5,320,100"]
        (arguments.folder / "metrics.csv").write_text("\n".join([columns, *rows]) + "\n")
        found = ours.evaluations_of(arguments)
        assert [(each.frames, each.success_rate, each.cpu_seconds) for each in found[:2]] == [(0, 0, 1), (50, 0.5, 60)]
        summary = {"frames": 80, "wall_seconds": 180.0, "episodes": 500, "return_mean": 0.7, "success_rate": 0.75}
        summary["processor_seconds"] = 120.0
        (arguments.folder / "summary.json").write_text(json.dumps(summary | {"steps_mean": 200.0}))
        final = ours.evaluations_of(arguments)[-1]
        assert (final.frames, final.episodes, final.success_rate, final.cpu_seconds) == (80, 500, 0.75, 120.0)
        assert len(ours.evaluations_of(arguments)) == 3 and final.sampled_success_rate is None
        assert [each.final for each in ours.evaluations_of(arguments)] == [False, False, True]

    @pytest.mark.parametrize(("seconds", "over"), [(100.0, False), (99.0, True)])
    def test_a_run_that_has_used_up_its_time_is_over_without_a_summary(self, tmp_path, seconds, over):
        arguments = OurArguments(id=TASK, runs=tmp_path, seconds=seconds)
        arguments.folder.mkdir()
        columns = "frames,wall_seconds,processor_seconds,greedy/return,greedy/success,greedy/steps,greedy/episodes"
        rows = ["0,1.5,1,0.0,0.0,640,100", "50,90.0,60,0.4,0.5,320,100", "80,150.0,99,,,,"]
        (arguments.folder / "metrics.csv").write_text("\n".join([columns, *rows]) + "\n")
        assert [each.final for each in ours.evaluations_of(arguments)] == [False, over]

    def test_sigterm_stops_the_training_too(self, tmp_path):
        (tmp_path / "train.py").write_text(
            "import pathlib, signal, sys, time\n"
            "signal.signal(signal.SIGTERM, lambda *_: (pathlib.Path('stopped').touch(), sys.exit(143)))\n"
            "pathlib.Path('begun').touch()\ntime.sleep(60)\n"
        )
        peers = Path(ours.__file__).parent
        program = f"import sys; sys.path.insert(0, {str(peers)!r}); import ours; ours.ROOT = ours.Path('.').resolve(); "
        program += f"ours.PAUSE = 0.1; ours.train(ours.OurArguments(id={TASK!r}, runs=ours.Path('runs')))"
        with subprocess.Popen([sys.executable, "-c", program], cwd=tmp_path) as process:
            wait_until((tmp_path / "begun").exists, 60)
            process.terminate()
            assert process.wait(60) == 0
        assert (tmp_path / "stopped").exists()

    @pytest.mark.parametrize("code", [0, 143, -15, 1])
    def test_a_run_that_is_stopped_is_no_error_and_one_that_fails_is(self, tmp_path, monkeypatch, code):
        signals = []

        class Process:
            returncode = None

            def __init__(self, words, env):
                assert words[1].endswith("train.py") and env["OMP_NUM_THREADS"] == "1"
                arguments.folder.mkdir()
                (arguments.folder / "metrics.csv").write_text("frames,processor_seconds\n10,101.0\n")

            def __enter__(self):
                return self

            def __exit__(self, *_):
                pass

            def poll(self):
                return self.returncode

            def wait(self):
                self.returncode = code

            def send_signal(self, number):
                signals.append(number)

        monkeypatch.setattr(ours.subprocess, "Popen", Process)
        arguments = OurArguments(id=TASK, runs=tmp_path, seconds=100.0)
        if code == 1:
            with pytest.raises(SystemExit, match=r"train\.py ended with exit code 1"):
                ours.train(arguments)
        else:
            ours.train(arguments)
        assert signals == [ours.signal.SIGTERM]

    def test_time_that_was_used_up_starts_nothing(self, tmp_path, monkeypatch):
        arguments = OurArguments(id=TASK, runs=tmp_path, seconds=100.0)
        arguments.folder.mkdir()
        (arguments.folder / "metrics.csv").write_text("frames,processor_seconds\n10,101.0\n")
        monkeypatch.setattr(ours.subprocess, "Popen", None)
        ours.train(arguments)


class TestTable:
    @pytest.fixture
    def results(self, tmp_path):
        for seed, end in ((0, 0.8), (1, 1.0)):
            write(tmp_path / f"a{seed}.jsonl", [evaluation(0, 0.0, seed=seed), evaluation(200, end, seed=seed)])
        slow = {"agent": "recurrent_ppo", "seconds": 8.0, "sampled": 0.4}
        write(
            tmp_path / "b.jsonl", [evaluation(0, 0.0, agent="recurrent_ppo", sampled=0.0), evaluation(100, 0.2, **slow)]
        )
        return tmp_path

    @pytest.mark.parametrize(
        ("axis", "end", "returns"),
        [
            ("frames", "100 frames", ["0.23 (-0.09 to 0.54)", "0.10"]),
            ("cpu_seconds", "2 s", ["0.45 (-0.19 to 1.09)", "0.03"]),
        ],
    )
    def test_agents_are_compared_where_the_first_run_ended(self, results, axis, end, returns):
        rows = table.rows_of(TASK, table.read_all(results)[TASK], axis)
        cells = [[cell.strip() for cell in row.split("|")][2:6] for row in rows]
        assert [row[:3] for row in cells] == [
            [end, "v3 without hierarchy, bonus", "2"],
            [end, "RecurrentPPO (sb3-contrib), bonus", "1"],
        ]
        assert [row[3] for row in cells] == returns

    def test_hierarchical_agents_have_no_bonus_to_tell_of(self):
        labels = [table.label_of(evaluation(0, 0.0, agent=agent, bonus=0.0)) for agent in table.AGENTS]
        assert table.label_of(evaluation(0, 0.0, agent="recurrent_ppo", bonus=0.1)).endswith(", bonus 0.1")
        assert labels[:3] == ["hDRQNv3", "hDRQNv3, three levels", "v3 without hierarchy, no bonus"]

    def test_agents_without_probabilities_have_no_success_with_drawn_actions(self, results):
        rows = table.rows_of(TASK, table.read_all(results)[TASK], "frames")
        assert [row.split("|")[8].strip() for row in rows] == ["-", "0.40"]

    def test_the_figure_has_a_curve_for_each_agent_and_an_interval_where_there_are_seeds(self, results, figures):
        table.draw(table.read_all(results), results / "peers.png")
        returns, seconds, frames = figures[0].axes
        assert [text.get_text() for text in returns.get_legend().get_texts()] == [
            "v3 without hierarchy, bonus",
            "RecurrentPPO (sb3-contrib), bonus",
        ]
        assert np.allclose(returns.lines[0].get_xydata()[-1], (2, 0.45)) and len(returns.lines) == 2
        assert np.allclose(frames.lines[0].get_xydata()[-1], (200, 0.9))
        assert np.allclose(seconds.lines[2].get_xydata()[-1], (8, 0.2))
        assert np.allclose(seconds.lines[3].get_xydata()[-1], (8, 0.4))
        assert (results / "peers.png").stat().st_size > 0

    def test_a_run_that_is_not_over_is_left_out_with_a_warning(self, results, capsys):
        write(results / "c.jsonl", [evaluation(0, 0.0, agent="xuance_drqn", final=False)])
        assert len(table.read_all(results)[TASK]) == 2
        assert "left out: c.jsonl is not over" in capsys.readouterr().err

    def test_tables_are_written_between_their_marks(self, results, figures, monkeypatch):
        page = results / "page.md"
        parts = [f"<!-- {mark} -->\n<!-- end of {mark} -->" for mark in ("at equal time", "at equal frames")]
        page.write_text("before\n" + "\n".join(parts) + "\nafter\n")
        words = ["--results", str(results), "--page", str(page), "--figure", str(results / "peers.png")]
        monkeypatch.setattr("sys.argv", ["table.py", *words])
        table.main()
        text = page.read_text()
        assert text.startswith("before\n") and text.endswith("after\n") and text.count(f"`{TASK}`") == 4
        assert "| 2 s |" in text.partition("at equal frames")[0] and "| 100 frames |" in text
