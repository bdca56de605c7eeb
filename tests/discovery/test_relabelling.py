"""Stored steps told anew must be what the environment would have written."""

import pytest
import torch
from hand_given import BOTH_GOALS, GoalsUnderTheAgent
from helpers import small_env
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose, InitTracker

from hdrqn_torchrl.data import make_sequence_buffer
from hdrqn_torchrl.discovery import DiscoveredSubgoals, EventCritic, SubgoalTable, relabel
from hdrqn_torchrl.transforms import SubgoalTransform

ALL = torch.ones(3, dtype=torch.bool)


def stored(assigned, rows, steps=60):
    """A memory of random play with a table, and that table; it wraps if ``rows`` are fewer than ``steps``."""
    torch.manual_seed(0)
    critic = EventCritic(GoalsUnderTheAgent(), SubgoalTable(2))
    critic.table.assign(assigned, once=[slot for slot in (1, 2) if slot in assigned.values()])
    book = SubgoalTransform(3, available_key="available")
    env = TransformedEnv(small_env(8, max_steps=9), Compose(DiscoveredSubgoals(critic), InitTracker(), book))
    memory = make_sequence_buffer(8 * rows, slice_len=2, batch_size=2, num_envs=8)
    for batch in Collector(env, None, frames_per_batch=8 * 6, total_frames=8 * steps):
        memory.extend(batch.clone())
    return memory, critic.table


@pytest.mark.parametrize("rows", [25, 100])
class TestRelabelling:
    def test_the_same_table_changes_nothing(self, rows):
        memory, table = stored(BOTH_GOALS.slots, rows)
        before = memory.storage[:].clone()
        memory.rewrite(lambda steps, newest: relabel(steps, table, newest=newest, kept=ALL))
        assert before["next", "attained"].any() and not before["subgoal_mask"][..., 1:].all()
        assert (memory.storage[:] == before).all()

    def test_steps_are_told_as_if_their_events_had_always_been_subgoals(self, rows):
        memory, table = stored({}, rows)
        assert not memory.storage[:]["next", "attained"].any()
        kept = table.assign(BOTH_GOALS.slots, once=BOTH_GOALS.once)
        memory.rewrite(lambda steps, newest: relabel(steps, table, newest=newest, kept=kept))
        steps, expected = memory.storage[:], stored(BOTH_GOALS.slots, rows)[0].storage[:]
        assert torch.equal(steps["next", "events"], expected["next", "events"])  # the same play
        assert torch.equal(steps["next", "attained"], expected["next", "attained"])
        whole = began_here(steps, memory)
        assert whole.float().mean() > 0.6
        assert torch.equal(steps["subgoal_mask"][whole], expected["subgoal_mask"][whole])

    def test_what_pursued_a_subgoal_of_another_meaning_counts_as_exploring(self, rows):
        memory, table = stored(BOTH_GOALS.slots, rows)
        before = memory.storage[:]["next", "active_subgoal"].clone()
        kept = table.assign({1: 1, 7: 2})
        memory.rewrite(lambda steps, newest: relabel(steps, table, newest=newest, kept=kept))
        after = memory.storage[:]["next", "active_subgoal"]
        assert (before == 2).any() and torch.equal(after, torch.where(before == 2, 0, before))


def began_here(steps, memory):
    """Steps of episodes whose beginning is stored, ``[rows, N]``."""
    episodes = steps["collector", "traj_ids"]
    begun = episodes[steps["is_init"].squeeze(-1)]
    return torch.isin(episodes, begun)


def test_an_empty_memory_is_left_alone():
    memory = make_sequence_buffer(100, slice_len=2, batch_size=2, num_envs=4)
    memory.rewrite(lambda steps, newest: pytest.fail("there is nothing to change"))
