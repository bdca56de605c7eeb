"""Targets of ``RecurrentDQNLoss`` that look further than one step, against numbers worked out by hand.

The network is a table. A sequence visits states 0, 1 and 2 and ends in state 3; the target network's values of these
states are 4 (state 1), 8 (state 2) and 6 (state 3), which action 0 has; rewards are 1, 0 and 2, the discount is 0.5.
"""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from hdrqn_torchrl.objectives import RecurrentDQNLoss, greedy_choice

TABLE = [[1.0, 0.0], [4.0, 2.0], [8.0, 6.0], [6.0, 3.0]]
OFF = None  # a step that is not trained


def flags(text):
    return torch.tensor([digit == "1" for digit in text]).view(1, -1, 1)


def targets(
    *, actions="000", done="000", terminated="000", init="000", valid="111", eligible=None, steps=None, allowed=None,
    **settings,
):  # fmt: skip
    """The target of each step, read off the gradient: d loss / d Q(s, a) = 2 (Q(s, a) - y) / trained steps."""
    table = nn.Embedding.from_pretrained(torch.tensor(TABLE, dtype=torch.double), freeze=False)
    loss = RecurrentDQNLoss(TensorDictModule(table, ["state"], ["action_value"]), gamma=0.5, burn_in=0.0, **settings)
    with torch.no_grad():
        table.weight.add_(100.0)  # the main network chooses alike, and no prediction is a target by chance
    sample = TensorDict(state=torch.tensor([[0, 1, 2]]), action=torch.tensor([[int(a) for a in actions]]))
    sample.batch_size = [1, 3]
    after = TensorDict(state=torch.tensor([[1, 2, 3]]), reward=torch.tensor([[[1.0], [0.0], [2.0]]]), batch_size=[1, 3])
    after.update({"done": flags(done), "terminated": flags(terminated)})
    sample.update({"is_init": flags(init), "next": after, ("collector", "mask"): flags(valid).squeeze(-1)})
    if eligible is not None:
        loss.set_keys(eligible="eligible")
        sample["eligible"] = flags(eligible)
    if steps is not None:
        loss.set_keys(steps="steps")
        after["steps"] = torch.tensor(steps).view(1, 3, 1)
    if allowed is not None:  # for states 0 to 3
        loss.set_keys(action_mask="allowed")
        masks = torch.stack([flags(mask).flatten() for mask in allowed.split()])[None]
        sample["allowed"], after["allowed"] = masks[:, :-1], masks[:, 1:]
    result = loss(sample)
    (gradient,) = torch.autograd.grad(result["loss"], table.weight)
    taken = [(state, int(action)) for state, action in enumerate(actions)]
    errors = [gradient[place].item() * result["trained_steps"].item() / 2 for place in taken]
    assert result["trained_steps"] == sum(error != 0 for error in errors)
    predictions = [table.weight[place].item() for place in taken]
    return [OFF if not error else round(q - error, 9) for q, error in zip(predictions, errors, strict=True)]


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        # y2 = 2 + 0.5 * 6; y1 = 0 + 0.5 * (0.5 * 8 + 0.5 * 5); y0 = 1 + 0.5 * (0.5 * 4 + 0.5 * 3.25)
        ({}, [2.8125, 3.25, 5.0]),
        # An exploratory action: the target before it takes the value only.
        ({"actions": "001"}, [3.0, 4.0, 5.0]),
        ({"actions": "010"}, [3.0, 3.25, 5.0]),
        ({"actions": "100"}, [2.8125, 3.25, 5.0]),  # the first action may be any
        # An option that terminates in the middle: y1 = 0; y0 = 1 + 0.5 * (0.5 * 4 + 0.5 * 0).
        ({"done": "010", "terminated": "010", "init": "001"}, [2.0, 0.0, 5.0]),
        ({"done": "001", "terminated": "001"}, [1 + 0.5 * (2 + 0.5 * 2.5), 0.5 * (4 + 0.5 * 2), 2.0]),
        # One that is cut in the middle: its last step is not trained, and the one before takes the value.
        ({"done": "010", "init": "001"}, [3.0, OFF, 5.0]),
        ({"done": "100", "init": "010"}, [OFF, 3.25, 5.0]),
        # A truncated episode at the end of the sequence: what followed is there.
        ({"done": "001"}, [2.8125, 3.25, 5.0]),
        # Padding.
        ({"valid": "110"}, [3.0, 4.0, OFF]),
        ({"valid": "110", "done": "011"}, [3.0, 4.0, OFF]),  # padding repeats the last step
        ({"valid": "100"}, [3.0, OFF, OFF]),
        # A restart that no end announces.
        ({"init": "001"}, [3.0, 4.0, 5.0]),
        # Options of 1, 2 and 3 steps: 2 + 0.125 * 6; 0 + 0.25 * (4 + 0.5 * 2.75); 1 + 0.5 * (2 + 0.5 * 1.34375).
        ({"steps": [1, 2, 3]}, [2.3359375, 1.34375, 2.75]),
        # The limit is for the final targets: y1 is computed with 5, y0 with 3.25.
        ({"max_target": 3.0}, [2.8125, 3.0, 3.0]),
        # Steps that may not be trained lend nothing.
        ({"eligible": "101"}, [3.0, OFF, 5.0]),
        ({"eligible": "110"}, [3.0, 4.0, OFF]),
        # In state 2 only action 1 is allowed: it is the greedy one there, and its value is 6.
        ({"allowed": "11 11 01 11", "actions": "001"}, [2.6875, 2.75, 5.0]),
        ({"allowed": "11 11 01 11", "actions": "000"}, [2.75, 3.0, 5.0]),
    ],
    ids=str,
)
def test_lambda(case, expected):
    assert targets(trace_decay=0.5, **case) == expected


@pytest.mark.parametrize(
    ("n", "case", "expected"),
    [
        (2, {}, [3.0, 2.5, 5.0]),  # 1 + 0 + 0.25 * 8; 0 + 0.5 * 2 + 0.25 * 6; shorter at the end
        (3, {}, [2.25, 2.5, 5.0]),  # 1 + 0 + 0.25 * 2 + 0.125 * 6
        (9, {}, [2.25, 2.5, 5.0]),
        (3, {"actions": "011"}, [2.25, 2.5, 5.0]),  # exploratory actions count like others
        (2, {"done": "010", "terminated": "010", "init": "001"}, [1.0, 0.0, 5.0]),
        (3, {"done": "001", "terminated": "001"}, [1.5, 1.0, 2.0]),
        (3, {"done": "010", "init": "001"}, [3.0, OFF, 5.0]),
        (2, {"valid": "110"}, [3.0, 4.0, OFF]),
        (3, {"valid": "110"}, [3.0, 4.0, OFF]),
        (2, {"init": "010"}, [3.0, 2.5, 5.0]),
        (2, {"steps": [1, 2, 3]}, [2.0, 0.6875, 2.75]),  # 1 + 0.5 * 0.25 * 8; 0 + 0.25 * (2 + 0.125 * 6)
        (3, {"max_target": 2.375}, [2.25, 2.375, 2.375]),
        (3, {"eligible": "110"}, [3.0, 4.0, OFF]),
        (2, {"allowed": "11 11 01 11"}, [2.5, 2.5, 5.0]),  # 1 + 0 + 0.25 * 6
    ],
    ids=str,
)
def test_n_steps(n, case, expected):
    assert targets(n_step=n, **case) == expected


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ({}, [3.0, 4.0, 5.0]),
        ({"done": "010", "terminated": "010", "init": "001"}, [3.0, 0.0, 5.0]),
        ({"done": "010", "init": "001"}, [3.0, OFF, 5.0]),
        ({"eligible": "101"}, [3.0, OFF, 5.0]),
        ({"eligible": "000"}, [OFF, OFF, OFF]),
        ({"steps": [1, 2, 3]}, [3.0, 2.0, 2.75]),
    ],
    ids=str,
)
@pytest.mark.parametrize("settings", [{}, {"trace_decay": 0.0, "n_step": 1}], ids=str)
def test_one_step(settings, case, expected):
    assert targets(**settings, **case) == expected


def test_a_short_trace_is_the_one_step_target():
    assert targets(trace_decay=1e-7) == pytest.approx(targets(), abs=1e-5)


def test_greedy_choice():
    value = torch.tensor([[1.0, 3.0, 2.0], [-1.0, -3.0, -2.0]])
    assert greedy_choice(value).tolist() == [1, 0]
    assert greedy_choice(value, torch.tensor([[True, False, True], [False, True, True]])).tolist() == [2, 2]
    assert greedy_choice(value, torch.zeros(2, 3, dtype=torch.bool)).tolist() == [1, 0]
