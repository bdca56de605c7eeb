import pytest
import torch

from hdrqn_torchrl.objectives import double_q_value, smdp_target, training_mask

NAN = float("nan")


def flags(text):
    """``"01 11"`` -> [[False, True], [True, True]]."""
    return torch.tensor([[digit == "1" for digit in row] for row in text.split()])


@pytest.mark.parametrize(
    ("online", "target", "mask", "value"),
    [
        ([1.0, 2.0, 0.0], [5.0, 3.0, 9.0], None, 3.0),  # chosen by the one, valued by the other
        ([1.0, 2.0, 0.0], [5.0, 3.0, 9.0], [True, False, True], 5.0),
        ([1.0, 2.0, 0.0], [5.0, 3.0, 9.0], [False, False, True], 9.0),
        ([1.0, 2.0, 0.0], [5.0, 3.0, 9.0], [False, False, False], 3.0),  # nothing to choose: as without a mask
        ([-1.0, -2.0, -3.0], [-5.0, -3.0, -9.0], [False, True, True], -3.0),
    ],
)
def test_double_q_value(online, target, mask, value):
    mask = None if mask is None else torch.tensor(mask)
    assert double_q_value(torch.tensor(online), torch.tensor(target), mask).item() == value


def test_double_q_value_of_a_batch():
    online, target = torch.tensor([[[1.0, 2.0], [2.0, 1.0]]]), torch.tensor([[[5.0, 6.0], [7.0, 8.0]]])
    assert double_q_value(online, target).tolist() == [[6.0, 7.0]]


@pytest.mark.parametrize(
    ("reward", "terminated", "next_value", "gamma", "steps", "target"),
    [
        (1.0, False, 4.0, 0.5, None, 3.0),  # 1 + 0.5 * 4
        (1.0, False, 4.0, 0.5, 1, 3.0),
        (1.0, False, 4.0, 0.5, 3, 1.5),  # 1 + 0.125 * 4
        (1.0, False, 4.0, 1.0, 7, 5.0),
        (1.0, False, 4.0, 0.0, 1, 1.0),
        (1.0, True, 4.0, 0.5, 2, 1.0),
        (-1.0, True, NAN, 0.5, None, -1.0),
        (-1.0, False, -2.0, 0.9, 2, -2.62),  # -1 - 0.81 * 2
    ],
)
def test_smdp_target(reward, terminated, next_value, gamma, steps, target):
    steps = None if steps is None else torch.tensor(steps)
    value = smdp_target(torch.tensor(reward), torch.tensor(terminated), torch.tensor(next_value), gamma, steps)
    assert value.item() == pytest.approx(target)


@pytest.mark.parametrize(
    ("valid", "init", "burn_in", "exact", "mask"),
    [
        # The paper's rule: the last half.
        ("11111111", "00000000", 0.5, False, "00001111"),
        ("11111111", "10000000", 0.5, False, "00001111"),
        ("1111111", "0000000", 0.5, False, "0001111"),  # 3.5 is rounded down
        ("11111111", "00000000", 0.0, False, "11111111"),
        ("1111", "0000", 0.99, False, "0001"),
        ("1", "0", 0.5, False, "1"),
        # Steps whose state is exact.
        ("11111111", "10000000", 0.5, True, "11111111"),
        ("11111111", "00100000", 0.5, True, "00111111"),
        ("11111111", "00000010", 0.5, True, "00001111"),
        ("11111111", "00000000", 0.5, True, "00001111"),
        # Padding counts for the half, but is never trained.
        ("11111100", "00000000", 0.5, False, "00001100"),
        ("11100000", "00000000", 0.5, False, "00000000"),
        ("11100000", "10000000", 0.5, False, "00000000"),
        ("11100000", "10000000", 0.5, True, "11100000"),
        ("11100000", "01000000", 0.9, True, "01100000"),
        ("10000000", "10000000", 0.5, True, "10000000"),
        ("11000000", "00010000", 0.5, True, "00000000"),  # a restart in the padding trains nothing
        # Rows are on their own.
        ("1111 1100 1111", "0000 0000 0100", 0.5, True, "0011 0000 0111"),
    ],
)
def test_training_mask(valid, init, burn_in, exact, mask):
    assert training_mask(flags(valid), flags(init), burn_in, exact).tolist() == flags(mask).tolist()
