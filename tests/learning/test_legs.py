import math

import pytest
import torch
from tensordict import TensorDict

from hdrqn_torchrl.keys import OptionKeys
from hdrqn_torchrl.learning.legs import LegCounter


def batch(*steps):
    """``[1, T]`` of steps (is_init, attained at a reset, option_init, pursued, attained, option_done)."""
    G = 2
    rows = {"root": [], "after": []}
    for is_init, began_at, option_init, pursued, attained, done in steps:
        rows["root"].append((is_init, one_hot(began_at, G), option_init))
        rows["after"].append((pursued, one_hot(attained, G), done, done and attained == pursued))
    is_init, began_at, option_init = (torch.tensor(column)[None] for column in zip(*rows["root"], strict=True))
    pursued, attained, done, reached = (torch.tensor(column)[None] for column in zip(*rows["after"], strict=True))
    after = {"active_subgoal": pursued, "attained": attained, "option_done": done[..., None]}
    root = {"is_init": is_init[..., None], "attained": began_at, "option_init": option_init[..., None]}
    return TensorDict({**root, "next": {**after, "subgoal_reached": reached[..., None]}}, [1, len(steps)])


def one_hot(index, size):
    return [index == place for place in range(size)]


EPISODE = [
    (True, None, True, 0, None, False),
    (False, None, False, 0, 0, True),  # start to 0: reached
    (False, None, True, 1, None, False),
    (False, None, False, 1, None, True),  # 0 to 1: given up
    (False, None, True, 1, 1, True),  # 0 to 1: reached
    (False, None, True, 0, None, True),  # 1 to 0: not reached, the episode ends
]


def test_options_are_counted_by_origin_and_target():
    legs = LegCounter(2)
    legs.observe(batch(*EPISODE))
    assert legs.options.tolist() == [[0, 2], [1, 0], [1, 0]]
    assert legs.reached.tolist() == [[0, 1], [0, 0], [1, 0]]
    assert legs.rates[0, 1] == 0.5 and math.isnan(legs.rates[1, 1])


def test_an_episode_begins_at_the_start_or_at_the_subgoal_of_its_reset():
    legs = LegCounter(2)
    legs.observe(batch(*EPISODE))
    legs.clear()
    legs.observe(batch((True, None, True, 1, 1, True), (True, 0, True, 1, None, True)))
    assert legs.options.tolist() == [[0, 1], [0, 0], [0, 1]]


def test_the_origin_of_an_option_does_not_change_on_its_way():
    legs = LegCounter(2)
    legs.observe(batch((True, None, True, 1, 0, False), (False, None, False, 1, 1, True)))
    assert legs.reached.tolist() == [[0, 0], [0, 0], [0, 1]]


def test_batches_can_be_cut_anywhere_and_a_state_carries_the_counts():
    whole, cut = LegCounter(2), LegCounter(2)
    whole.observe(batch(*EPISODE))
    for step in EPISODE:
        cut.observe(batch(step))
        restored = LegCounter(2)
        restored.load_state_dict(cut.state_dict())
        cut = restored
    assert (cut.options == whole.options).all() and (cut.reached == whole.reached).all()


def test_columns_of_legs_are_shares_and_a_new_row_counts_from_zero():
    legs = LegCounter(2)
    legs.observe(batch(*EPISODE))
    metrics = legs.metrics()
    assert list(metrics) == [f"legs/{origin}_to_{target}" for origin in (0, 1, "start") for target in (0, 1)]
    assert list(metrics.values()) == pytest.approx(legs.rates.flatten().tolist(), nan_ok=True)
    legs.clear()
    assert all(math.isnan(share) for share in legs.metrics().values())


def test_each_set_of_subgoals_has_entries_and_columns_of_its_own():
    yes, subgoal = torch.ones(1, 1, 1, dtype=torch.bool), torch.tensor([[1]])
    attained = torch.tensor([[[False, True]]])
    step = {f"rooms_{name}": yes for name in ("option_done", "subgoal_reached")}
    after = {"rooms_attained": attained, "rooms_active_subgoal": subgoal, **step}
    root = {"is_init": yes, "rooms_option_init": yes, "rooms_attained": ~(attained | yes), "next": after}
    legs = LegCounter(2, names=OptionKeys("rooms"))
    legs.observe(TensorDict(root, [1, 1]))
    assert legs.metrics()["rooms_legs/start_to_1"] == 1.0
