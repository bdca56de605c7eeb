"""Rounds of all workers' worlds: whose row is whose, whatever happens."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from stamped_worlds import AGENTS, EPISODE, StampedWorlds, make_grid_part, make_part
from workers_here import HereWorkers

from hdrqn_torchrl.algorithms import Algorithm
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.runs.collectors import ResumableCollector
from hdrqn_torchrl.runs.workers import WorkerLost, WorkersCollector

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


def check_sequences(algorithm) -> int:
    """Every sequence of steps shows one world, one episode, one step after the other. Returns their number."""
    found = 0
    for name, learner in algorithm.learners.items():
        if name == "meta":
            continue
        for _ in range(40):
            sample = learner.sample()
            shown = sample["observation"]
            real = sample.get(("collector", "mask"), torch.ones(sample.shape, dtype=torch.bool))[:, 1:]
            assert ((shown[:, 1:, :3] == shown[:, :-1, :3]).all(-1) | ~real).all()
            assert ((shown[:, 1:, 3] == shown[:, :-1, 3] + 1) | ~real).all()
            found += len(sample)
    return found


def options_by_hand(batches) -> list[tuple]:
    """(episode, subgoal, steps) of every option, row by row from what the worlds themselves showed."""
    whole, found = torch.cat(batches, 1), []
    for row in whole.unbind(0):
        length, last = 0, None
        for step in row.unbind(0):
            stamp = tuple(step["observation"][:3].tolist())
            starts = bool(step["option_init"])
            assert starts or stamp == last, "an option goes on in another episode"
            length, last = (1 if starts else length + 1), stamp
            if bool(step["next", "option_done"]):
                found.append((int(step["collector", "traj_ids"]), int(step["next", "active_subgoal"]), length))
    return found


def check_options(algorithm, batches) -> int:
    """The option memory holds those of the worlds' own logs, and no other one. Returns their number."""
    truth = options_by_hand(batches)
    stored = algorithm.learners["meta"].buffer[:]
    rows = zip(
        stored["collector", "traj_ids"].flatten().tolist(), stored["subgoal"].flatten().tolist(),
        stored["next", "option_steps"].flatten().tolist(), strict=True,
    )  # fmt: skip
    real = [row for row in rows if row[2] > 0]  # others are final rows
    for row in set(real):
        assert real.count(row) <= truth.count(row), row
    return len(real)


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


def test_episodes_have_numbers_of_their_own():
    _, collector = stamped("v3", 2)
    collector.place.loses.append(1)
    whole = torch.cat(rounds(collector, 6), 1)
    stamps = whole["observation"][..., :3].flatten(0, 1).tolist()
    numbers = whole["collector", "traj_ids"].flatten().tolist()
    assert len(set(map(tuple, stamps))) == len(set(numbers)) == len(set(zip(map(tuple, stamps), numbers, strict=True)))


def test_a_worker_that_is_replaced_plays_other_episodes():
    _, collector = stamped("v3", 2)
    batches = iter(collector)
    next(batches)
    collector.place.loses.append(0)
    next(batches)
    (_, first), (_, other), (_, again) = collector.place.started
    assert len({first, other, again}) == 3


def test_a_lost_episode_does_not_count_for_the_next_one():
    from hdrqn_torchrl.runs.evaluation import EpisodeTracker

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
