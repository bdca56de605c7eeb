"""What a misspelt setting was meant to be."""

import pytest
from processes import run_script

from hdrqn_torchrl.cli.misspelt import misspelt

CASES = {
    ("algoo=v2",): ("algoo", "did you mean algo?"),
    ("total_frame=5", "seed=1"): ("total_frame", "did you mean total_frames?"),
    ("algo.sub.slice_length=4",): ("algo.sub.slice_length", "did you mean algo.sub.slice_len"),
    ("slice_len=4",): ("slice_len", "did you mean algo.sub.slice_len or algo.meta.slice_len?"),
    ("-m", "seed=0,1", "env=gridworld,four_rooms", "env.num_goal=2,3"): ("env.num_goal", "did you mean env.num_goals"),
    ("zzz=1",): ("zzz", "must be a known setting; `"),
}


@pytest.mark.parametrize("arguments", CASES, ids=" ".join)
def test_a_misspelt_setting_is_named_with_those_that_it_resembles(arguments):
    key, meant = CASES[arguments]
    (sentence,) = misspelt(arguments)
    assert sentence.startswith(f"error: {key} must be a known setting; ")
    assert meant in sentence
    assert "--cfg job` shows every setting" in sentence


def test_entries_of_one_s_own_are_given_one_by_one():
    (sentence,) = misspelt(["env=gym", "env.settings={wheels:4}"])
    assert sentence.endswith("takes entries of your own one by one, not as a whole: '+env.settings.NAME=VALUE'.")


def test_each_of_several_is_named():
    assert [each.split()[1] for each in misspelt(["sed=1", "env.view=3", "total_frame=5"])] == ["sed", "total_frame"]


@pytest.mark.parametrize("arguments", [(), ("seed=1",), ("algo=v4",), ("seed",), ("+new=1",), ("seed=[",)])
def test_nothing_is_said_of_what_is_right_or_wrong_in_another_way(arguments):
    assert misspelt(arguments) == []


@pytest.mark.parametrize("given", [["--config-dir", "{}"], ["--config-dir={}"], ["-cd", "{}"]], ids=" ".join)
def test_files_of_the_user_are_known(tmp_path, given):
    (tmp_path / "env").mkdir()
    (tmp_path / "env" / "mine.yaml").write_text("_target_: mine.make\ncorridors: 3\n")
    arguments = [each.format(tmp_path) for each in given]
    (sentence,) = misspelt([*arguments, "env=mine", "env.corridor=4"])
    assert "did you mean env.corridors?" in sentence


def test_the_program_says_so(tmp_path):
    code, _, told = run_script(tmp_path, "total_frame=5")
    assert code == 1
    assert told.splitlines()[-1].startswith("error: total_frame must be a known setting; did you mean total_frames?")
