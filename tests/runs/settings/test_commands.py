import pytest

from hdrqn_torchrl.runs.settings import commands
from hdrqn_torchrl.runs.settings.commands import as_called, command_of


@pytest.mark.parametrize(
    ("called", "typed"),
    [
        ("hdrqn evaluate", "hdrqn train"),
        ("/usr/bin/hdrqn", "hdrqn train"),
        ("evaluate.py", "python train.py"),
        ("../a b/watch.py", "python '../a b/train.py'"),
        ("notebook.py", "python train.py"),  # in a checkout
    ],
)
def test_a_program_is_named_as_the_running_one_was_called(called, typed, monkeypatch):
    monkeypatch.setattr("sys.argv", [called, "run=a"])
    assert command_of("train") == typed


def test_without_scripts_it_is_the_command_that_the_package_installs(monkeypatch, tmp_path):
    monkeypatch.setattr("sys.argv", ["notebook.py"])
    monkeypatch.setattr(commands, "_TOP", tmp_path)
    assert command_of("plot") == "hdrqn plot"


def test_a_text_names_all_programs_in_that_way(monkeypatch):
    monkeypatch.setattr("sys.argv", ["hdrqn plot"])
    text = "python plot.py runs=a; python evaluate.py run=b; python mine.py"
    assert as_called(text) == "hdrqn plot runs=a; hdrqn evaluate run=b; python mine.py"
