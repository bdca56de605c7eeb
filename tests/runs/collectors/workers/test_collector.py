"""Rounds of all workers' worlds: whose row is whose, whatever happens."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from stamped_worlds import AGENTS, EPISODE, StampedWorlds, make_grid_part, make_part
from workers_here import HereWorkers
from world_logs import check_options, check_sequences

from hdrqn_torchrl.algorithms import Algorithm
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.runs.collectors.resumable import ResumableCollector
from hdrqn_torchrl.runs.collectors.workers import PlaceLost, WorkerLost, WorkersCollector

WORLDS, STEPS = 8, 8


def stamped(agent: str, workers: int, *, place=None, **arguments) -> tuple[Algorithm, WorkersCollector]:
    torch.manual_seed(0)
    env = StampedWorlds(WORLDS, seed=0)
    algorithm = AGENTS[agent](env)
    place = place or HereWorkers(partial(make_part, agent, WORLDS // workers))
    collector = WorkersCollector(
        place, algorithm.transform(env), algorithm.policy, workers=workers,
        **{"total_frames": 10**9, **arguments},
    )  # fmt: skip
    return algorithm, collector


def rounds(collector, number):
    batches = iter(collector)
    return [next(batches).clone() for _ in range(number)]


def learned(algorithm, collector, number, *, lost=None):
    """Learns from so many rounds; after some of them workers are lost. Returns the rounds."""
    seen, batches = [], iter(collector)
    for index in range(number):
        seen.append(next(batches).clone())
        algorithm.observe(seen[-1])
        for learner in algorithm.learners.values():
            for _ in range(min(1, learner.updates_due())):
                learner.learn()
        collector.update_policy_weights_()
        if lost is not None:
            lost(index)
    return seen


@pytest.mark.parametrize("agent", ["v2", "v3"])
@pytest.mark.parametrize("sync", [True, False])
def test_nothing_of_one_world_ends_in_another_when_workers_are_lost(agent, sync):
    algorithm, collector = stamped(agent, 2, sync=sync)

    def lost(index):
        if index % 9 == 4:
            collector.place.loses.append(index % 2)

    batches = learned(algorithm, collector, 100, lost=lost)
    assert collector.metrics()["collector/lost_workers"] == 11
    assert collector.metrics()["collector/lost_episodes"] == 44
    assert check_sequences(algorithm) >= 300
    if agent == "v2":
        assert check_options(algorithm, batches) >= 1_000


@pytest.mark.parametrize("lost", ["loses", "refuses"])
@pytest.mark.parametrize("sync", [True, False])
def test_episodes_have_numbers_of_their_own(sync, lost):
    _, collector = stamped("v3", 2, sync=sync)
    batches = iter(collector)
    seen = [next(batches).clone() for _ in range(2)]
    getattr(collector.place, lost).append(1)
    whole = torch.cat([*seen, *(next(batches).clone() for _ in range(5))], 1)
    assert collector.lost_workers == 1
    stamps = whole["observation"][..., :3].flatten(0, 1).tolist()
    numbers = whole["collector", "traj_ids"].flatten().tolist()
    assert len(set(map(tuple, stamps))) == len(set(numbers)) == len(set(zip(map(tuple, stamps), numbers, strict=True)))


def test_a_worker_that_is_not_to_wait_is_asked_again_as_soon_as_it_has_delivered():
    _, collector = stamped("v3", 2, sync=False)
    batches = iter(collector)
    next(batches)
    collector.place.calls.clear()
    next(batches)
    assert collector.place.calls == [("receive", 0), ("send", 0), ("receive", 1), ("send", 1)]


def test_a_worker_that_is_replaced_plays_other_episodes():
    _, collector = stamped("v3", 2)
    batches = iter(collector)
    next(batches)
    collector.place.loses.append(0)
    next(batches)
    (_, first), (_, other), (_, again) = collector.place.started
    assert len({first, other, again}) == 3


def test_a_worker_that_is_lost_while_its_state_is_asked_for_leaves_no_number_to_another_episode():
    _, collector = stamped("v3", 2)
    before = rounds(collector, 1)[0]["collector", "traj_ids"][:, -1].unique().tolist()
    collector.place.loses.append(1)
    state = collector.state_dict()
    assert collector.lost_workers == state["lost_workers"] == 1
    _, again = stamped("v3", 2)
    again.load_state_dict(state)
    after = rounds(again, 1)[0]["collector", "traj_ids"]
    assert (after[WORLDS // 2 :, 0].unsqueeze(-1) != torch.tensor(before)).all()
    assert torch.equal(after, rounds(collector, 1)[0]["collector", "traj_ids"])


def test_a_lost_episode_does_not_count_for_the_next_one():
    from hdrqn_torchrl.runs.episode_tracker import EpisodeTracker

    algorithm, collector = stamped("v3", 2)
    tracker, found = EpisodeTracker(algorithm.task), []
    for index, batch in enumerate(rounds(collector, 5)):
        found += tracker.finished(batch)["steps"].tolist()
        if index == 1:
            collector.place.loses.append(0)
    assert set(found) == {EPISODE}


def test_one_worker_that_is_waited_for_is_no_other_than_none():
    def parts():
        torch.manual_seed(3)
        env = MultiGoalGridEnv(num_envs=4, seed=5)
        algorithm = AGENTS["v3"](env)
        return algorithm, algorithm.transform(env)

    algorithm, env = parts()
    local = ResumableCollector(
        env, algorithm.policy, frames_per_batch=32, total_frames=320, auto_register_policy_transforms=False
    )
    expected = learned(algorithm, local, 10)
    algorithm, env = parts()
    place = HereWorkers(partial(make_grid_part, 4))
    collector = WorkersCollector(place, env, algorithm.policy, workers=1, total_frames=320, seed=5)
    found = learned(algorithm, collector, 10)
    for one, other in zip(found, expected, strict=True):
        assert (one["action"] == other["action"]).all()
        assert (one["observation"] == other["observation"]).all()


@pytest.mark.parametrize("sync", [True, False])
def test_it_goes_on_where_its_state_was_taken(sync):
    algorithm, collector = stamped("v3", 2, sync=sync)
    learned(algorithm, collector, 4)
    state, weights = collector.state_dict(), {k: v.clone() for k, v in algorithm.policy.state_dict().items()}
    before, expected = collector.metrics(), rounds(collector, 3)
    other, again = stamped("v3", 2, sync=sync)
    other.policy.load_state_dict(weights)
    again.load_state_dict(state)
    assert again.metrics() == before
    for one, two in zip(rounds(again, 3), expected, strict=True):
        assert (one["observation"] == two["observation"]).all()
        assert (one["action"] == two["action"]).all()
        assert (one["collector", "traj_ids"] == two["collector", "traj_ids"]).all()


def test_the_age_of_weights_is_told():
    done = [0]
    _, waiting = stamped("v3", 2, updates=lambda: done[0])
    for _, _ in zip(range(3), waiting, strict=False):
        done[0] += 5
    assert waiting.metrics()["collector/weights_age_max"] == 0
    _, ahead = stamped("v3", 2, sync=False, updates=lambda: done[0])
    for _, _ in zip(range(3), ahead, strict=False):
        done[0] += 5
    assert ahead.metrics()["collector/weights_age_max"] == 5
    ahead.clear()
    assert ahead.metrics()["collector/weights_age_max"] == 0


def test_weights_reach_the_workers():
    algorithm, collector = stamped("v3", 2)
    batches = iter(collector)
    next(batches)
    with torch.no_grad():
        for parameter in algorithm.policy.parameters():
            parameter.fill_(0.25)
    collector.update_policy_weights_()
    next(batches)
    for worker in collector._workers:
        assert all((parameter == 0.25).all() for parameter in worker.worker.policy.parameters())


def test_it_ends_after_total_frames_and_nothing_is_ordered_beyond():
    _, collector = stamped("v3", 2, sync=False, total_frames=192)
    assert sum(batch.numel() for batch in collector) == 192
    assert not collector._ordered
    collector.shutdown()
    collector.shutdown()
    assert collector.place.closed == 2


def test_a_worker_that_is_always_lost_ends_the_collection():
    _, collector = stamped("v3", 2)
    collector.place.loses += [1, 1, 1]
    with pytest.raises(WorkerLost, match=r"worker 1 was lost, 3 times in a row; .* collector\.patience_seconds"):
        next(iter(collector))


@pytest.mark.parametrize("workers", [0, 3])
def test_worlds_must_be_divided_evenly(workers):
    with pytest.raises(ValueError, match=f"workers must divide num_envs=8, got {workers}"):
        stamped("v3", workers, place=object())


def test_a_state_of_another_number_of_workers_is_refused():
    _, collector = stamped("v3", 2)
    state = collector.state_dict()
    _, other = stamped("v3", 4)
    with pytest.raises(ValueError, match=r"collector\.workers must be as before, got 4 for the state of 2 workers"):
        other.load_state_dict(state)
    with pytest.raises(ValueError, match="the state of a collector without workers"):
        other.load_state_dict({})
    algorithm = AGENTS["v3"](StampedWorlds(WORLDS))
    local = ResumableCollector(
        algorithm.transform(StampedWorlds(WORLDS)), algorithm.policy, frames_per_batch=WORLDS * STEPS, total_frames=-1,
        auto_register_policy_transforms=False,
    )  # fmt: skip
    with pytest.raises(ValueError, match="collector must be one with 2 workers, as before, got local"):
        local.load_state_dict(state)


@pytest.mark.parametrize("sync", [True, False])
def test_when_the_place_has_gone_none_is_replaced_and_new_episodes_begin_where_its_state_is_loaded(sync):
    algorithm, collector = stamped("v3", 2, sync=sync)
    before = learned(algorithm, collector, 4)
    collector.place.has_gone = True
    with pytest.raises(PlaceLost, match="the place must answer"):
        rounds(collector, 3 if sync else 2)
    assert len(collector.place.started) == 2
    collector.give_up(collector.frames)
    state = collector.state_dict()
    assert state["workers"] == [None, None]
    assert collector.metrics()["collector/lost_workers"] == 2
    _, again = stamped("v3", 2, sync=sync)
    again.load_state_dict(state)
    later = rounds(again, 3)
    assert again.frames == collector.frames + sum(batch.numel() for batch in later)
    assert not stamps(before) & stamps(later)
    assert not numbers_of(before) & numbers_of(later)


def stamps(batches):
    return {tuple(stamp) for batch in batches for stamp in batch["observation"][..., :3].flatten(0, 1).tolist()}


def numbers_of(batches):
    return {number for batch in batches for number in batch["collector", "traj_ids"].flatten().tolist()}
