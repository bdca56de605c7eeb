"""What scripted players achieve: known, kept, played in time, or left out."""

import json
import time

import pytest
import torch
from helpers import small_env
from torchrl.envs import RewardScaling, StepCounter, TransformedEnv

from hdrqn_torchrl.envs import MultiGoalGridEnv, Reference, Task, task_of
from hdrqn_torchrl.runs import references
from hdrqn_torchrl.runs.references import Players, ceiling_of, references_for


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return references.cache_folder()


class Player:
    """Plays once for each call."""

    def __init__(self):
        self.calls = 0

    def __call__(self, seconds):
        self.calls += 1
        torch.rand(3)
        return {"return_mean": 0.5 + self.calls}


def task_with(player, **more):
    return Task(references={"hero": Reference(what="all there is", play=player, **more)}, ceiling="hero")


def test_the_figures_of_the_papers_tasks_are_known_without_playing():
    told = []
    found = references_for(MultiGoalGridEnv(2).task, tell=told.append)
    assert list(found) == ["planner", "memory", "egocentric", "random"] and told == []


def test_unknown_figures_are_played_when_asked_for_and_kept():
    player, told = Player(), []
    task = task_with(player, key="a task")
    assert player.calls == 0
    for _ in range(2):
        assert references_for(task, tell=told.append) == {"hero": {"return_mean": 1.5}}
    assert player.calls == 1
    assert told == ["the scripted player 'hero' (all there is) plays this task, for at most 120 s"]


def test_another_task_another_version_and_a_player_without_a_key_are_played_again(monkeypatch):
    player = Player()
    for key in ("a", "b"):
        references_for(task_with(player, key=key))
    monkeypatch.setattr(references, "__version__", "another")
    references_for(task_with(player, key="a"))
    assert player.calls == 3
    for _ in range(2):
        references_for(task_with(player))
    assert player.calls == 5


@pytest.mark.parametrize("text", ["", "{", "[]", json.dumps({"key": "a", "figures": {"return_mean": "high"}}), "\x00"])
def test_a_damaged_cache_is_ignored(cache, text):
    player = Player()
    task = task_with(player, key="a")
    references_for(task)
    (file,) = cache.iterdir()
    file.write_text(text)
    assert references_for(task) == {"hero": {"return_mean": 2.5}}


def test_where_nothing_can_be_kept_players_play_each_time(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    player = Player()
    for _ in range(2):
        assert references_for(task_with(player, key="a"))
    assert player.calls == 2


def test_a_player_whose_time_is_up_is_left_out_with_a_message():
    told, begun = [], time.monotonic()
    task = MultiGoalGridEnv(1, layout="nine_rooms", max_steps=150).task
    assert references_for(task, ["egocentric"], seconds=0.2, tell=told.append) == {}
    assert time.monotonic() - begun < 10
    assert told[-1] == "the scripted player 'egocentric' was not done after 0.2 s: it is left out"
    assert ceiling_of({}, task) is None


def test_without_play_only_what_is_known_is_found():
    player = Player()
    assert references_for(task_with(player, key="a"), play=False) == {} and player.calls == 0
    assert references_for(task_with(player, known={"return_mean": 1.0}), play=False) == {"hero": {"return_mean": 1.0}}


def test_a_players_random_numbers_are_its_own():
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    references_for(task_with(Player()))
    assert (torch.rand(2) == expected).all()


def test_the_task_names_its_ceiling():
    found = {"planner": {"return_mean": 2.0}, "memory": {"return_mean": 1.9}}
    assert ceiling_of(found, MultiGoalGridEnv(1).task) == 1.9
    assert ceiling_of(found, Task()) is None


def test_a_task_without_players_has_no_figures():
    assert references_for(Task()) == {}


def test_players_of_a_task_with_other_rewards_or_shorter_episodes_do_not_play():
    for transform in (RewardScaling(0.0, 2.0), StepCounter(max_steps=3)):
        assert references_for(task_of(TransformedEnv(small_env(2), transform))) == {}
    assert task_of(TransformedEnv(small_env(2), StepCounter(max_steps=10_000))).references


def test_a_ceiling_that_is_not_a_reference_is_refused():
    with pytest.raises(ValueError, match=r"ceiling must be one of the references \[\], got 'memory'"):
        Task(ceiling="memory")


def test_players_of_a_run_play_once_and_only_when_asked_for():
    hero, other = Player(), Player()
    both = {"hero": Reference(what="", play=hero), "other": Reference(what="", play=other)}
    players = Players(Task(references=both, ceiling="hero"))
    assert (hero.calls, other.calls) == (0, 0)
    assert [players.ceiling() for _ in range(3)] == [1.5] * 3 and (hero.calls, other.calls) == (1, 0)
    assert list(players()) == ["hero", "other"] and (hero.calls, other.calls) == (1, 1)
    assert Players(Task(references=both, ceiling="hero"), play=False).ceiling() is None
