"""Which worlds are blocked, and what an agent earns there."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import blocked_worlds
from blocked_worlds import Scripted, Settings

from hdrqn_torchrl.envs import FullInformationPlanner, MultiGoalGridEnv
from hdrqn_torchrl.envs.grid.scripted import UniformRandom
from hdrqn_torchrl.runs.settings.arguments import SettingsError


def figures(monkeypatch, capsys, player):
    """What is printed of a player who takes the agent's part, by the kind of world."""
    env = MultiGoalGridEnv(100, layout="four_rooms", num_goals=3, max_steps=100)
    algorithm = SimpleNamespace(transform=lambda world: world, policy=Scripted(player(env)))
    monkeypatch.setattr(
        blocked_worlds, "load_agent", lambda *_, **__: SimpleNamespace(config=None, algorithm=algorithm)
    )
    monkeypatch.setattr(blocked_worlds, "build_env", lambda *_: env)
    blocked_worlds.run(Settings(run="anything", episodes=300, num_envs=100))
    return {told.pop("worlds"): told for told in map(json.loads, capsys.readouterr().out.splitlines())}


def test_the_player_who_sees_all_earns_in_open_worlds_all_there_is_and_is_as_good_as_itself(monkeypatch, capsys):
    told = figures(monkeypatch, capsys, FullInformationPlanner)
    assert told["open"]["share"] + told["blocked"]["share"] == pytest.approx(1.0)
    assert 0.02 < told["blocked"]["share"] < 0.12
    assert (told["open"]["agent"]["return"], told["open"]["agent"]["success"]) == (3.0, 1.0)
    assert told["blocked"]["agent"]["return"] <= 2.5
    assert all(each["agent"] == each["sees_all"] for each in told.values())


def test_another_player_earns_less_in_the_same_worlds(monkeypatch, capsys):
    told = figures(monkeypatch, capsys, UniformRandom)
    assert all(each["agent"]["return"] < each["sees_all"]["return"] for each in told.values())


def test_a_task_without_such_a_player_is_refused(monkeypatch):
    monkeypatch.setattr(blocked_worlds, "load_agent", lambda *_, **__: SimpleNamespace(config=None))
    monkeypatch.setattr(blocked_worlds, "build_env", lambda *_: None)
    with pytest.raises(SettingsError, match="run must be of a grid task, got anything"):
        blocked_worlds.run(Settings(run="anything"))
