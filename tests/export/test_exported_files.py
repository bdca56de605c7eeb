"""Files of a decision: written, read back, and the same as the policy."""

import json

import pytest
import torch
from exported_agents import KINDS, make_agent
from helpers import build

from hdrqn_torchrl.envs import make_gym
from hdrqn_torchrl.export import DecisionStep, agreement_with, check_file, export_step, files, load_step

PACKAGES = ("onnx", "onnxscript", "onnxruntime")


def written(kind, path):
    algorithm, env = make_agent(kind)
    step = DecisionStep(algorithm, env)
    export_step(step, path)
    return step, env


def check(kind, path):
    if path.suffix == ".onnx":
        for package in PACKAGES:
            pytest.importorskip(package, reason="the extra 'export' is not installed")
    step, env = written(kind, path)
    found = agreement_with(load_step(path), step, env)
    assert (found.episodes, found.other_actions) == (50, 0) and found.largest_difference <= 1e-5
    assert [file.name for file in path.parent.iterdir()] == [path.name]  # nothing beside it


def test_a_program_decides_as_the_policy_in_50_whole_episodes(tmp_path):
    check("drqn", tmp_path / "agent.pt2")
    extra = {"hdrqn_torchrl.json": ""}
    torch.export.load(tmp_path / "agent.pt2", extra_files=extra)
    assert json.loads(extra["hdrqn_torchrl.json"])["state"] == ["sub_hidden", "sub_cell"]


@pytest.mark.slow
@pytest.mark.parametrize("ending", files.ENDINGS)
@pytest.mark.parametrize("kind", KINDS)
def test_every_agent_can_be_exported(kind, ending, tmp_path):
    check(kind, tmp_path / f"agent{ending}")


def test_a_file_says_what_its_inputs_are():
    algorithm, env = make_agent("v3 with three levels", 2)
    about = files.describe(DecisionStep(algorithm, env))
    assert about["observed"] == ["observation", "is_init", "attained", "rooms_attained", "rooms_available"]
    assert {"active_subgoal", "rooms_subgoal_mask", "memory_cell", "previous_action"} < set(about["state"])
    assert about["subgoals"]["active_subgoal"] == ["goal 1", "goal 2"] and len(about["subgoals"]) == 2


def test_a_file_says_which_actions_of_the_task_its_numbers_are():
    some = make_gym("FrozenLake-v1", num_envs=2, actions=[3, 2], seed=0)
    algorithm = build("drqn", some)
    assert files.describe(DecisionStep(algorithm, algorithm.transform(some)))["actions"] == [3, 2]
    algorithm, env = make_agent("v2", 2)
    assert files.describe(DecisionStep(algorithm, env))["actions"] == [0, 1, 2, 3]


@pytest.mark.parametrize("name", ["agent", "agent.pt", "agent.ONNX.zip"])
def test_a_file_of_another_kind_is_refused(name, tmp_path):
    for call in (check_file, load_step):
        with pytest.raises(ValueError, match=r"out must end in \.onnx or \.pt2, got"):
            call(tmp_path / name)


def test_an_extra_that_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "find_spec", lambda name: None if name == "onnxruntime" else object())
    with pytest.raises(ValueError, match=r"needs onnxruntime: pip install 'hdrqn_torchrl\[export\]', or write a \.pt2"):
        check_file(tmp_path / "agent.onnx")
    check_file(tmp_path / "agent.pt2")
