"""export.py on a run folder as train.py leaves it."""

import sys

import pytest
import torch
from run_folders import write_run

import hdrqn_torchrl.export as package
from hdrqn_torchrl.cli import export
from hdrqn_torchrl.cli.command_line import command_line


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("outputs") / "run"
    folder.mkdir()
    write_run(folder)
    return folder


@pytest.fixture
def command(monkeypatch, tmp_path, capsys):
    """Runs ``export.py`` in this process, in an empty folder; returns what it printed."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["export.py", *map(str, arguments)])
        command_line(export.Settings, export.__doc__, export.run)
        return capsys.readouterr().out

    return call


def test_a_run_becomes_a_file_that_is_compared_with_its_agent(run, command, tmp_path):
    written, compared = command(f"run={run}", "out=new/agent.pt2", "episodes=3").splitlines()
    assert written.startswith("new/agent.pt2: ") and "takes observation, is_init, attained; state: act" in written
    assert compared.startswith("3 episodes, ") and "0 other actions than the agent's" in compared
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["agent.pt2"]


def test_a_file_that_differs_from_the_agent_is_reported(run, command, monkeypatch):
    def load_step(path):
        return lambda inputs: {**step(inputs), "action_value": torch.full((1, 4), 9.0)}

    def export_step(made, path):
        nonlocal step
        step = made
        path.touch()

    step = None
    monkeypatch.setattr(package, "export_step", export_step)
    monkeypatch.setattr(package, "load_step", load_step)
    monkeypatch.setattr(package, "check_file", lambda path: None)  # the packages of the extra are not needed here
    with pytest.raises(SystemExit, match=r"error: agent\.onnx differs by more than 1e-05 from the agent; use \.pt2"):
        command(f"run={run}", "out=agent.onnx", "episodes=1")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["out=agent.zip"], r"out must end in \.onnx or \.pt2, got 'agent\.zip'"),
        (["out=agent.pt2", "episodes=-1"], r"episodes must be >= 0, got -1"),
        ([], r"out must be given"),
    ],
)
def test_mistakes_are_told_before_anything_is_written(run, command, tmp_path, arguments, message):
    with pytest.raises(SystemExit, match=message):
        command(f"run={run}", *arguments)
    assert not list(tmp_path.iterdir())
