"""The scripts in examples/ run, with settings that take seconds."""

import runpy
import sys
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from processes import ROOT

from hdrqn_torchrl import rendering
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
