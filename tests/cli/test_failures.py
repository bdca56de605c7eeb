"""What a training that fails says."""

import re
from types import SimpleNamespace

import pytest
from helpers import make_training

from hdrqn_torchrl.cli.configuration import RunError
from hdrqn_torchrl.cli.failures import in_words, noting_errors
from hdrqn_torchrl.cli.resuming import Plan
from hdrqn_torchrl.learning import LearnerSettings
from hdrqn_torchrl.learning.finite import NonFiniteError

CONFIG = SimpleNamespace(allowed_targets=["mine.Maze"], seed=7)


def told(folder, error, *, saved=False):
    """The message after an error in a training of 128 frames."""
    plan, trainer = Plan(folder, CONFIG, {}, resumed=False), make_training(folder, total_frames=128)
    if saved:
        trainer.train()
    trainer.frames = 128
    with pytest.raises(RunError) as reason, noting_errors(plan), in_words(plan, trainer=trainer):
        raise error
    return str(reason.value)


def test_an_error_of_an_environment_is_told_with_its_place_and_the_command_that_goes_on(tmp_path, capsys):
    error = ZeroDivisionError("division by zero")
    error.add_note("In world 3.")
    assert re.fullmatch(
        rf"ZeroDivisionError: division by zero \(after frame 128, seed 7; traceback in {tmp_path}/error\.txt\); when "
        rf"that is fixed, `\S.* resume={tmp_path} '?allowed_targets=\[mine\.Maze\]'?` goes on from the last "
        r"checkpoint, checkpoint-000000000128\. In world 3\.",
        told(tmp_path, error, saved=True),
    )
    assert "Traceback" in capsys.readouterr().err and "ZeroDivisionError" in (tmp_path / "error.txt").read_text()


def test_a_setting_that_shows_only_in_training_to_be_wrong_is_told_with_how_another_value_is_taken(tmp_path):
    with pytest.raises(ValueError) as of_the_package:
        LearnerSettings(tau=2.0)
    message = told(tmp_path, of_the_package.value, saved=True)
    assert message.startswith("tau must be in (0, 1]") and "with KEY=VALUE resume_override=true" in message
    assert "resume_override" not in told(tmp_path / "other", ValueError("of a world"))


def test_where_nothing_was_saved_the_training_begins_again(tmp_path):
    assert "` begins again, as nothing was saved before." in told(tmp_path, RuntimeError("broken"))


def test_an_error_of_the_machine_comes_without_a_traceback(tmp_path, capsys):
    assert told(tmp_path, OSError("disk full"), saved=True).startswith("disk full (after frame 128, seed 7; ")
    assert "Traceback" not in capsys.readouterr().err


def test_a_nan_is_told_with_the_command_that_goes_on(tmp_path):
    message = told(tmp_path, NonFiniteError("reward is NaN; the last good checkpoint is X."))
    assert re.fullmatch(
        rf"reward is NaN; the last good checkpoint is X\. When that is fixed, `.* resume={tmp_path} .*` goes on\.",
        message,
    )
