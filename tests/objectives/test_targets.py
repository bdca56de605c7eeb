import pytest
import torch

from hdrqn_torchrl.objectives import (
    double_q_value,
    importance_weight,
    lambda_returns,
    n_step_returns,
    sequence_priority,
    smdp_target,
    target_lookahead,
    training_mask,
    watkins_trace,
)

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


@pytest.mark.parametrize(
    ("valid", "init", "lookahead", "mask"),
    [
        ("11111111", "00000000", 2, "00011100"),  # half of six steps
        ("11111111", "10000000", 2, "11111100"),
        ("11111111", "00000001", 2, "00011100"),
        ("11110000", "01000000", 2, "01110000"),
        ("11111111", "00000000", 7, "10000000"),
        ("11111111", "10000000", 8, "00000000"),
    ],
)
def test_steps_that_serve_targets_only_are_not_trained_and_count_for_no_half(valid, init, lookahead, mask):
    assert training_mask(flags(valid), flags(init), 0.5, True, lookahead).tolist() == flags(mask).tolist()


@pytest.mark.parametrize(
    ("trace_decay", "n_step", "slice_len", "steps"),
    [
        (0.0, 1, 8, 0),
        (0.0, 5, 8, 4),
        (0.0, 9, 2, 8),
        (0.5, 1, 8, 1),
        (0.8, 1, 8, 4),
        (0.8, 1, 3, 3),
        (0.85, 1, 8, 6),  # 5.67
        (0.01, 1, 8, 1),
        (0.99, 1, 50, 50),
        (1.0, 1, 8, 8),
    ],
)
def test_target_lookahead(trace_decay, n_step, slice_len, steps):
    assert target_lookahead(trace_decay, n_step, slice_len) == steps


def row(text):
    """``"1 0 nan"`` -> [[1.0, 0.0, nan]]."""
    return torch.tensor([[float(number) for number in text.split()]])


@pytest.mark.parametrize(
    ("reward", "ended", "next_value", "trace", "discount", "targets"),
    [
        # lambda 0 is the one-step target.
        ("1 0 2", "000", "4 8 6", "0 0 0", 0.5, "3 4 5"),
        # lambda 1 without cuts sums up the rewards and takes the last value: 1 + 0.5 * 0 + 0.25 * 2 + 0.125 * 6.
        ("1 0 2", "000", "4 8 6", "1 1 1", 0.5, "2.25 2.5 5"),
        ("1 0 2", "000", "4 8 6", "1 1 0", 0.5, "2.25 2.5 5"),  # the last trace has nothing to take over
        ("1 0 2", "000", "4 8 6", "0.5 0.5 0.5", 0.5, "2.8125 3.25 5"),
        # Cuts.
        ("1 0 2", "000", "4 8 6", "0.5 0 0.5", 0.5, "3 4 5"),
        ("1 0 2", "000", "4 8 6", "0 0.5 0.5", 0.5, "3 3.25 5"),
        ("1 0 2", "000", "4 8 6", "1 0 1", 0.5, "3 4 5"),
        # Ends: what follows is not read, and the step before takes over the bare reward.
        ("1 0 2", "010", "4 nan 6", "1 1 1", 0.5, "1 0 5"),
        ("1 0 2", "010", "4 nan 6", "0.5 0.5 0.5", 0.5, "2 0 5"),
        ("1 0 2", "001", "4 8 nan", "1 1 1", 0.5, "1.5 1 2"),
        ("1 0 2", "111", "nan nan nan", "1 1 1", 0.5, "1 0 2"),
        # A discount for each transition (options of 1, 2 and 3 steps).
        ("1 0 2", "000", "4 8 6", "0 0 0", "0.5 0.25 0.125", "3 2 2.75"),
        ("1 0 2", "000", "4 8 6", "1 1 1", "0.5 0.25 0.125", "1.34375 0.6875 2.75"),
        ("1 0 2", "000", "4 8 6", "1 1 1", 0.0, "1 0 2"),
        ("3", "0", "4", "1", 0.5, "5"),
        ("3", "1", "nan", "1", 0.5, "3"),
    ],
)
def test_lambda_returns(reward, ended, next_value, trace, discount, targets):
    discount = row(discount) if isinstance(discount, str) else discount
    found = lambda_returns(row(reward), flags(ended), row(next_value), row(trace), discount)
    torch.testing.assert_close(found, row(targets), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("greedy", "trace"),
    [
        ("111", "0.5 0.5 0"),
        ("011", "0.5 0.5 0"),  # whether the first action is greedy concerns no target
        ("101", "0 0.5 0"),
        ("110", "0.5 0 0"),
        ("000", "0 0 0"),
        ("1", "0"),
    ],
)
def test_watkins_trace(greedy, trace):
    assert watkins_trace(flags(greedy), 0.5).tolist() == row(trace).tolist()


@pytest.mark.parametrize(
    ("reward", "ended", "next_value", "follows", "n", "targets"),
    [
        ("1 0 2", "000", "4 8 6", "111", 1, "3 4 5"),
        ("1 0 2", "000", "4 8 6", "111", 2, "3 2.5 5"),  # 1 + 0.5 * 0 + 0.25 * 8
        ("1 0 2", "000", "4 8 6", "111", 3, "2.25 2.5 5"),
        ("1 0 2", "000", "4 8 6", "111", 9, "2.25 2.5 5"),  # shorter at the end of the sequence
        ("1 0 2", "010", "4 nan 6", "111", 2, "1 0 5"),
        ("1 0 2", "010", "4 nan 6", "101", 3, "1 0 5"),
        ("1 0 2", "000", "4 8 6", "011", 3, "3 2.5 5"),
        ("1 0 2", "000", "4 8 6", "101", 3, "3 4 5"),  # 1 + 0.5 * (0 + 0.5 * 8)
        ("1 0 2", "000", "4 8 6", "000", 3, "3 4 5"),
    ],
)
def test_n_step_returns(reward, ended, next_value, follows, n, targets):
    found = n_step_returns(row(reward), flags(ended), row(next_value), flags(follows), 0.5, n)
    torch.testing.assert_close(found, row(targets), rtol=0, atol=1e-6)


def test_n_step_returns_with_a_discount_for_each_transition():
    found = n_step_returns(row("1 0 2"), flags("000"), row("4 8 6"), flags("111"), row("0.5 0.25 0.125"), 2)
    assert found.tolist() == row("2 0.6875 2.75").tolist()  # 1 + 0.5 * (0 + 0.25 * 8)


@pytest.mark.parametrize("n", [0, -1])
def test_n_step_returns_of_no_step(n):
    with pytest.raises(ValueError, match=f"n must be >= 1 step, got {n}; "):
        n_step_returns(row("1"), flags("0"), row("1"), flags("1"), 0.5, n)


class TestAgainstPlainLoops:
    """Random sequences ``[B, T, G]`` with ends and cuts."""

    SHAPE = (4, 9, 3)

    @pytest.fixture(autouse=True)
    def random_sequences(self):
        self.reward, self.next_value = torch.randn(2, *self.SHAPE)
        self.ended = torch.rand(self.SHAPE) < 0.2
        self.greedy = torch.rand(self.SHAPE) < 0.6
        self.discount = torch.rand(self.SHAPE)

    def check(self, found, target):
        """``target(r, e, v, f, d, t)`` computes one target from lists along time."""
        for b in range(self.SHAPE[0]):
            for g in range(self.SHAPE[2]):
                columns = (self.reward, self.ended, self.next_value, self.greedy, self.discount)
                lists = [column[b, :, g].tolist() for column in columns]
                wanted = [target(*lists, t) for t in range(self.SHAPE[1])]
                assert found[b, :, g].tolist() == pytest.approx(wanted, abs=1e-5)

    @pytest.mark.parametrize("trace_decay", [0.0, 0.3, 1.0])
    def test_watkins_q_lambda(self, trace_decay):
        def target(reward, ended, value, greedy, discount, t):
            if ended[t]:
                return reward[t]
            if t + 1 == len(reward) or not greedy[t + 1]:
                return reward[t] + discount[t] * value[t]
            later = target(reward, ended, value, greedy, discount, t + 1)
            return reward[t] + discount[t] * ((1 - trace_decay) * value[t] + trace_decay * later)

        trace = watkins_trace(self.greedy, trace_decay)
        self.check(lambda_returns(self.reward, self.ended, self.next_value, trace, self.discount), target)

    @pytest.mark.parametrize("n", [1, 2, 4, 20])
    def test_n_steps(self, n):
        def target(reward, ended, value, follows, discount, t):
            total, weight = 0.0, 1.0
            for step in range(t, min(t + n, len(reward))):
                total += weight * reward[step]
                weight *= discount[step]
                if ended[step]:
                    return total
                if not follows[step]:
                    break
            return total + weight * value[step]

        found = n_step_returns(self.reward, self.ended, self.next_value, self.greedy, self.discount, n)
        self.check(found, target)

    def test_the_lambda_return_is_the_mean_of_the_n_step_returns(self):
        """The forward view, weights (1 - lambda) lambda^(n - 1); the longest return has what is left."""
        length, share = self.SHAPE[1], 0.7
        always = torch.ones_like(self.ended)
        mean = 0.0
        for n in range(1, length + 1):
            returns = n_step_returns(self.reward, self.ended, self.next_value, always, self.discount, n)
            mean = mean + (share ** (n - 1) * (1 - share if n < length else 1.0)) * returns
        trace = share * always.float()
        found = lambda_returns(self.reward, self.ended, self.next_value, trace, self.discount)
        torch.testing.assert_close(found, mean)

    def test_nothing_that_is_given_is_changed(self):
        trace = watkins_trace(self.greedy, 0.5)
        given = (self.reward, self.ended, self.next_value, trace, self.discount)
        copies = [tensor.clone() for tensor in given]
        lambda_returns(*given)
        n_step_returns(self.reward, self.ended, self.next_value, self.greedy, self.discount, 3)
        assert all((tensor == copy).all() for tensor, copy in zip(given, copies, strict=True))


@pytest.mark.parametrize(
    ("errors", "trained", "priority"),
    [
        ([1.0, -3.0, 2.0], "111", 0.9 * 3 + 0.1 * 2),
        ([1.0, -3.0, 2.0], "101", 0.9 * 2 + 0.1 * 1.5),
        ([1.0, -3.0, NAN], "110", 0.9 * 3 + 0.1 * 2),
        ([1.0, -3.0, 2.0], "000", 0.0),
        ([-0.5, 7.0, 7.0], "100", 0.5),
    ],
)
def test_sequence_priority(errors, trained, priority):
    error, trained = torch.tensor([errors, [0.0] * 3]), torch.cat([flags(trained), flags("111")])
    assert sequence_priority(error, trained).tolist() == pytest.approx([priority, 0.0])
    several = torch.stack([error, error], -1), torch.stack([trained, torch.zeros_like(trained)], -1)
    assert sequence_priority(*several).tolist() == pytest.approx([priority, 0.0])  # the second column does not count
    assert sequence_priority(torch.tensor([[1.0, 3.0]]), flags("11"), largest=0.5).item() == pytest.approx(2.5)


def test_importance_weight():
    weight = torch.tensor([[0.5, 0.5], [2.0, 2.0], [1.0, 1.0]])
    assert importance_weight(weight).tolist() == [0.25, 1.0, 0.5]
