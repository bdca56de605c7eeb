"""The scripts in examples/ run, with settings that take seconds."""

import runpy
import sys
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from helpers import build
from processes import ROOT

from hdrqn_torchrl import rendering
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.export import DecisionStep, export_step
from hdrqn_torchrl.runs import evaluation


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Runs ``python examples/NAME ARGUMENTS`` in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")

    return run


def test_the_option_book_works_on_minigrid(run, capsys):
    pytest.importorskip("minigrid")
    run("reuse_transform.py", "--frames", "1280")
    assert len(capsys.readouterr().out.splitlines()) == 6


def test_the_loss_works_with_a_stock_network(run, capsys):
    run("reuse_loss.py", "--updates", "20")
    told = capsys.readouterr().out.splitlines()
    assert len(told) == 12 and told[-1].startswith("return after: ")


def test_the_way_from_an_id_to_a_trained_agent_ends_with_its_pictures(run, monkeypatch, capsys):
    pytest.importorskip("minigrid")
    for module, name in ((evaluation, "evaluate"), (rendering, "record_episodes")):
        monkeypatch.setattr(module, name, partial(getattr(module, name), max_steps=5))
    run("own_task/door_key.py", "--frames", "256", "--out", "door_key")
    assert "of 100 greedy episodes" in capsys.readouterr().out
    plt.close("all")
    assert sorted(path.name for path in Path().iterdir()) == ["door_key.gif", "door_key.png"]


@pytest.mark.slow  # the export alone takes seconds
@pytest.mark.parametrize("algorithm", ["dqn", "v3"])
def test_an_exported_agent_is_played_as_the_agent_plays_without_torch(run, algorithm, tmp_path, capsys):
    pytest.importorskip("onnxscript", reason="the extra 'export' is not installed")
    pytest.importorskip("onnxruntime", reason="the extra 'export' is not installed")
    env = MultiGoalGridEnv(1)
    agent = build(algorithm, env)
    export_step(DecisionStep(agent, agent.transform(env)), tmp_path / "agent.onnx")
    run("onnx_player.py", "agent.onnx", "hdrqn_torchrl.envs.gym:hdrqn/Gridworld-v0", "3")
    played = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [(words[1], words[-2]) for words in played] == [("0:", "50"), ("1:", "50"), ("2:", "50")]
    assert "import torch" not in (ROOT / "examples/onnx_player.py").read_text()
