"""The programs with an agent that finds its subgoals itself."""

import csv
import json
import sys
from importlib import import_module
from pathlib import Path

import pytest
from PIL import Image
from processes import run_script
from programs import TINY

from hdrqn_torchrl.cli import evaluate, plot, watch
from hdrqn_torchrl.cli.command_line import command_line

ROOM = "env.layout=['#####','#   #','#   #','#   #','#####']"
FINDING = [
    *TINY, ROOM, "env.view=3", "env.num_obstacles=0", "algo=v3", "algo.subgoals=discovered", "logger=csv",
    "algo.discovery.max_subgoals=3", "algo.discovery.warmup_frames=800", "algo.discovery.discovery_frames=200",
    "algo.learner.batch_size=4", "algo.learner.warmup_frames=200", "algo.learner.frames_per_update=100",
    "algo.memory_size=8", "algo.head_size=8", "evaluation.ceilings=false",
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    code, _, told = run_script(folder, *FINDING, "hydra.run.dir=run")
    assert code == 0, told
    return folder


def call(program, monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", [program.__name__, *arguments])
    command_line(program.Settings, program.__doc__, program.run)


def test_a_run_logs_its_subgoals_and_when_they_were_found(folder):
    with (folder / "run" / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    numbers = [float(row["discovery/subgoals"]) for row in rows]
    assert numbers[0] == 0 and numbers[-1] >= 2
    assert 800 <= float(rows[-1]["discovery/found_1"]) <= 2000


def test_an_evaluation_names_the_subgoals_that_were_found(folder, monkeypatch, capsys):
    call(evaluate, monkeypatch, f"run={folder / 'run'}", "checkpoint=last", "episodes=8", "num_envs=8")
    names = [each["name"] for each in json.loads(capsys.readouterr().out)["per_subgoal"]]
    assert names[0] == "explore" and {"(1, 1): 3 -> 0", "(1, 1): 4 -> 0"} <= set(names)


def test_its_subgoals_can_be_watched(folder, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    call(watch, monkeypatch, f"run={folder / 'run'}", "checkpoint=last", "out=sheet.png", "episodes=5", "epsilon=1.0")
    assert Image.open("sheet.png").height > 100


def test_a_figure_shows_when_they_were_found(folder, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    call(plot, monkeypatch, f"runs={folder / 'run'}", "out=[found.png,found.csv]", "kind=discovery")
    assert "runs 1, groups 1" in capsys.readouterr().out and Image.open("found.png").height > 100
    assert "discovery/subgoals" in Path("found.csv").read_text()


def test_its_subgoals_are_scored_by_what_only_the_environment_knows(folder, monkeypatch, capsys):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks" / "discovery")
    call(import_module("trained"), monkeypatch, f"run={folder / 'run'}", "frames=1_600", "epsilon=1.0", "num_envs=16")
    scored = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {each["subgoal"]: each["precision"] for each in scored["matches"]} == {"goal 1": 1.0, "goal 2": 1.0}


def test_workers_are_refused(folder):
    code, _, told = run_script(folder, *FINDING, "collector=processes", "collector.workers=2", "hydra.run.dir=workers")
    assert code != 0 and "collector must be local with algo.subgoals=discovered, got processes" in told
