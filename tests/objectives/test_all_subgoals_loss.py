"""The loss compared with plain loops, first on tables of values instead of networks, then on real networks."""

import math
from itertools import product
from types import SimpleNamespace

import pytest
import torch
from helpers import collect, parameter_distance, small_env, tiny_settings
from tensordict import TensorDict
from torch import nn

from hdrqn_torchrl.algorithms import make_v3
from hdrqn_torchrl.modules import AllSubgoalsPolicy, compact_network
from hdrqn_torchrl.objectives import AllSubgoalsLoss

B, T, G, A = 12, 14, 3, 3
PENALTY = {"wrong_subgoal_reward": -0.5}  # the default is 0
DEFAULTS = {
    "sub_gamma": 0.95,
    "meta_gamma": 0.97,
    "trace_decay": 0.8,
    "reached_reward": 1.0,
    **PENALTY,
    "hazard_reward": -1.0,
    "double": True,
    "all_subgoals": True,
    "intra_option": True,
    "max_meta_target": math.inf,
    "min_meta_target": -math.inf,
    "burn_in": 0.0,
    "lookahead": 1,
    "train_exact_states": True,
    "loss_function": "l2",
}
# Where each argument changes the loss on the random sequences below.
CHANGES = [
    {"sub_gamma": 0.5},
    {"meta_gamma": 0.5},
    {"trace_decay": 0.0},
    {"trace_decay": 1.0},
    {"reached_reward": 0.25},
    {"wrong_subgoal_reward": 0.0},
    {"hazard_reward": 0.0},
    {"double": False},
    {"all_subgoals": False},
    {"intra_option": False},
    {"all_subgoals": False, "intra_option": False},
    {"intra_option": False, "trace_decay": 0.0},
    {"intra_option": False, "double": False},
    {"max_meta_target": 0.4},
    {"min_meta_target": 0.1},
    {"max_meta_target": 0.4, "min_meta_target": 0.0},
    {"wrong_subgoal_reward": 0.5},
    {"hazard_reward": 0.5},
    {"burn_in": 0.5, "train_exact_states": False},
    {"lookahead": 3},
    {"lookahead": 2, "burn_in": 0.5, "train_exact_states": False, "intra_option": False},
    {"loss_function": "smooth_l1"},
]


class Tables(nn.Module):
    """A "network" whose values at a step are free parameters; the observation is the number of the step."""

    hidden_size = 1
    predictor = None

    def __init__(self, steps, subgoals=G, actions=A):
        super().__init__()
        self.num_subgoals = (subgoals,)
        self.action_value = nn.Parameter(torch.randn(steps, subgoals, actions))
        self.subgoal_value = nn.Parameter(torch.randn(steps, subgoals))

    def unroll(self, observation, previous_action, init, masks, state=None):
        return (self.action_value[observation], self.subgoal_value[observation].unsqueeze(-2)), observation


def make_loss(steps=B * T, *, subgoals=G, actions=A, **settings):
    """A loss with two tables; the target network's values differ from those of the main network."""
    loss = AllSubgoalsLoss(AllSubgoalsPolicy(Tables(steps, subgoals, actions)), **(PENALTY | settings))
    with torch.no_grad():
        for value in loss.target_policy_params.values(True, True):
            if value.numel() > 1:
                value.copy_(torch.randn_like(value))
    return loss


def tables(loss):
    main, target = loss.policy_params["network"], loss.target_policy_params["network"]
    return [main["action_value"], main["subgoal_value"], target["action_value"], target["subgoal_value"]]


def in_sequences(loss):
    """The tables as ``[B, T, ...]``."""
    return [table.unflatten(0, (-1, T)) for table in tables(loss)]


def play(loss, seed=0):
    """Random sequences ``[B, T]`` of several episodes each, mostly greedy for the subgoal pursued."""
    generator = torch.Generator().manual_seed(seed)

    def chance(probability):
        return torch.rand((), generator=generator).item() < probability

    def choice(options):
        return options[int(torch.randint(len(options), (), generator=generator))]

    rows = [_play_row(tables(loss)[0], b * T, chance, choice) for b in range(B)]
    td = TensorDict(
        {key: torch.tensor([[step[key] for step in row] for row in rows]) for key in rows[0][0]}, batch_size=(B, T)
    )
    flags = ("is_init", "option_init", "hazard", "done", "terminated", "extrinsic_reward")
    after = ("attained", "hazard", "done", "terminated", "extrinsic_reward", "active_subgoal")
    td.update({key: td[key].unsqueeze(-1) for key in flags})
    td["next"] = td.select(*after)
    td = td.exclude(*after)
    td["previous_action"] = torch.zeros(B, T, dtype=torch.int64)
    return td


def _play_row(action_value, first, chance, choice):
    row, new_episode, subgoal = [], True, 0
    for t in range(T):
        if new_episode:
            left, starts = [True] * G, True
        subgoal = choice([g for g in range(G) if left[g]]) if starts else subgoal
        greedy = action_value[first + t, subgoal].argmax().item()
        attained = [left[g] and chance(0.12) for g in range(G)]
        now = {"observation": first + t, "is_init": new_episode, "option_init": starts, "subgoal_mask": list(left)}
        now |= {"active_subgoal": subgoal, "attained": attained, "hazard": chance(0.15)}
        now |= {"action": greedy if chance(0.75) else choice(range(A)), "extrinsic_reward": choice([0.0, 0.01, 1.0])}
        left = [was and not reached for was, reached in zip(left, attained, strict=True)]
        terminated, truncated = not any(left) or chance(0.05), chance(0.08)
        new_episode = terminated or truncated
        starts = attained[subgoal] or not left[subgoal] or chance(0.1)
        row.append(now | {"terminated": terminated, "done": new_episode})
    return row


def start_in_mid_episode(td):
    """The first episode of every other sequence began earlier."""
    td["is_init"][::2, 0] = False
    return td


def pad(td, seed=0):
    """Cuts sequences off after 1 to T steps; the rest repeats the last step, as in the replay memory."""
    lengths = torch.randint(1, T + 1, (B,), generator=torch.Generator().manual_seed(seed))
    lengths[0], lengths[1] = T, T - 1
    padded = td[torch.arange(B)[:, None], torch.arange(T).expand(B, T).minimum(lengths[:, None] - 1)].contiguous()
    padded["collector", "mask"] = torch.arange(T) < lengths[:, None]
    return padded


class Reference:
    """The equations of the module's docstring, step by step and subgoal by subgoal."""

    def __init__(self, values, td, **settings):
        self.s = SimpleNamespace(**(DEFAULTS | settings))
        self.q, self.m, self.target_q, self.target_m = (value.tolist() for value in values)
        self.rows, self.steps, self.subgoals = td["subgoal_mask"].shape
        self.action = td["action"].tolist()
        self.left, self.starts = td["subgoal_mask"].tolist(), td["option_init"].squeeze(-1).tolist()
        self.init = td["is_init"].squeeze(-1).tolist()
        mask = td.get(("collector", "mask"), torch.ones(self.rows, self.steps, dtype=torch.bool))
        self.length = mask.sum(1).tolist()
        after = td["next"]
        self.attained, self.subgoal = after["attained"].tolist(), after["active_subgoal"].tolist()
        names = ("hazard", "done", "terminated", "extrinsic_reward")
        self.hazard, self.done, self.terminated, self.extrinsic = (after[key].squeeze(-1).tolist() for key in names)

    def run(self):
        """Errors of all trained entries by (row, time, subgoal), of the sub level and of the meta level."""
        sub, meta = {}, {}
        for b, t, g in product(range(self.rows), range(self.steps - 1), range(self.subgoals)):
            exact = self.s.train_exact_states and any(self.init[b][: t + 1])
            steps = self.steps - self.s.lookahead
            if (t < int(steps * self.s.burn_in) and not exact) or t >= self.length[b] or t >= steps:
                continue
            if self.trains_sub(b, t, g):
                only_reaching_pays = max(self.s.wrong_subgoal_reward, self.s.hazard_reward) <= 0
                target = self.sub_target(b, t, g)
                target = min(target, self.s.reached_reward) if only_reaching_pays else target
                sub[b, t, g] = self.q[b][t][g][self.action[b][t]] - target
            if self.trains_meta(b, t, g):
                target = self.meta_target(b, t, g) if self.s.intra_option else self.option_target(b, t)
                target = min(max(target, self.s.min_meta_target), self.s.max_meta_target)
                meta[b, t, g] = self.m[b][t][g] - target
        return sub, meta

    def cut_off(self, b, t):
        return (self.done[b][t] or t == self.length[b] - 1) and not self.terminated[b][t]

    def greedy(self, b, t, g):
        values = self.q[b][t][g]
        return self.action[b][t] == values.index(max(values))

    def trains_sub(self, b, t, g):
        pursued = self.s.all_subgoals or g == self.subgoal[b][t]
        known = self.attained[b][t][g] or not self.cut_off(b, t)
        return self.left[b][t][g] and known and pursued

    def trains_meta(self, b, t, g):
        pursued = g == self.subgoal[b][t]
        belongs = pursued or self.greedy(b, t, g)
        if not self.s.all_subgoals:
            belongs = pursued
        if not self.s.intra_option:
            belongs = pursued and self.starts[b][t]
        return self.left[b][t][g] and not self.cut_off(b, t) and belongs

    def option_target(self, b, t):
        """The return of the whole option plus the best value after it or, where it breaks off, that of going on."""
        total, discount, subgoal = 0.0, 1.0, self.subgoal[b][t]
        while True:
            total += discount * self.extrinsic[b][t]
            discount *= self.s.meta_gamma
            if self.terminated[b][t]:
                return total
            t += 1
            unknown = t == self.steps - 1 or self.cut_off(b, t)
            if self.starts[b][t]:
                break
            if unknown:
                return total + discount * self.target_m[b][t][subgoal]
        left = [other for other in range(self.subgoals) if self.left[b][t][other]]
        chooser = (self.m if self.s.double else self.target_m)[b][t]
        following = self.target_m[b][t][max(left, key=lambda other: chooser[other])]
        greedy = max(left, key=lambda other: self.m[b][t][other]) == self.subgoal[b][t]
        if greedy and not unknown:
            decay = self.s.trace_decay
            following = (1 - decay) * following + decay * self.option_target(b, t)
        return total + discount * following

    def sub_target(self, b, t, g):
        reward = self.s.reached_reward if self.attained[b][t][g] else 0.0
        if any(self.attained[b][t][other] for other in range(self.subgoals) if other != g):
            reward += self.s.wrong_subgoal_reward
        if self.hazard[b][t]:
            reward += self.s.hazard_reward
        if self.attained[b][t][g] or self.terminated[b][t]:
            return reward
        chooser = (self.q if self.s.double else self.target_q)[b][t + 1][g]
        value = self.target_q[b][t + 1][g][chooser.index(max(chooser))]
        unknown = self.cut_off(b, t + 1) and not self.attained[b][t + 1][g]
        following = self.mixed(b, t, g, value, self.sub_target, unknown)
        return reward + self.s.sub_gamma * following

    def meta_target(self, b, t, g):
        if self.terminated[b][t]:
            return self.extrinsic[b][t]
        value = self.target_m[b][t + 1]
        if self.attained[b][t][g]:
            chooser = (self.m if self.s.double else self.target_m)[b][t + 1]
            left = [other for other in range(self.subgoals) if self.left[b][t + 1][other]]
            following = value[max(left, key=lambda other: chooser[other])]
        else:
            following = self.mixed(b, t, g, value[g], self.meta_target, self.cut_off(b, t + 1))
        return self.extrinsic[b][t] + self.s.meta_gamma * following

    def mixed(self, b, t, g, value, target, unknown):
        if t + 1 == self.steps - 1 or unknown or not self.greedy(b, t + 1, g):
            return value
        return (1 - self.s.trace_decay) * value + self.s.trace_decay * target(b, t + 1, g)


def mean_square(errors):
    return sum(error**2 for error in errors.values()) / len(errors)


def mean_loss(errors, loss_function="l2"):
    if loss_function == "l2":
        return mean_square(errors)
    huber = [error**2 / 2 if abs(error) < 1 else abs(error) - 0.5 for error in errors.values()]
    return sum(huber) / len(huber)


def slope(error, loss_function="l2"):
    """Derivative of one entry's loss with respect to its value."""
    return 2 * error if loss_function == "l2" else max(-1.0, min(1.0, error))


class TestAgainstPlainLoops:
    @pytest.mark.parametrize(("change", "seed"), [(None, 0), (pad, 1), (start_in_mid_episode, 0)])
    @pytest.mark.parametrize("settings", [{}, {"burn_in": 0.5}, *CHANGES], ids=str)
    def test_losses_targets_and_masks_equal_those_of_plain_loops(self, settings, seed, change):
        """A table's gradient at an entry is 2 (value - target) / count where it is trained, and 0 elsewhere."""
        torch.manual_seed(seed)
        loss = make_loss(**settings)
        td = play(loss, seed)
        td = td if change is None else change(td)
        result = loss(td.clone())
        result["loss"].backward()
        sub, meta = Reference(in_sequences(loss), td, **settings).run()
        function = settings.get("loss_function", "l2")
        wanted = [mean_loss(errors, function) for errors in (sub, meta)]
        assert [result["sub_loss"].item(), result["meta_loss"].item()] == pytest.approx(wanted, rel=1e-5)
        assert result["loss"].item() == pytest.approx(sum(wanted), rel=1e-5)

        action_value, subgoal_value, *_ = tables(loss)
        expected_sub, expected_meta = torch.zeros_like(action_value), torch.zeros_like(subgoal_value)
        for (b, t, g), error in sub.items():
            expected_sub[b * T + t, g, td["action"][b, t]] = slope(error, function) / len(sub)
        for (b, t, g), error in meta.items():
            expected_meta[b * T + t, g] = slope(error, function) / len(meta)
        torch.testing.assert_close(action_value.grad, expected_sub, rtol=1e-4, atol=1e-7)
        torch.testing.assert_close(subgoal_value.grad, expected_meta, rtol=1e-4, atol=1e-7)

    @pytest.mark.parametrize("settings", [{}, {"loss_function": "smooth_l1"}, {"all_subgoals": False}], ids=str)
    def test_weighted_losses_and_priorities_of_both_levels_equal_those_of_plain_loops(self, settings):
        loss = make_loss(**settings)
        td = pad(play(loss))
        td["priority_weight"] = (1.0 + torch.arange(B))[:, None].expand(B, T)
        result, weight = loss(td), [(1 + b) / B for b in range(B)]
        function = settings.get("loss_function", "l2")
        levels = Reference(in_sequences(loss), td, **settings).run()
        for key, errors in zip(("sub_loss", "meta_loss"), levels, strict=True):
            wanted = sum(weight[place[0]] * mean_loss({0: error}, function) for place, error in errors.items())
            assert result[key].item() == pytest.approx(wanted / len(errors), rel=1e-5)
        assert result["loss"].item() == pytest.approx(result["sub_loss"].item() + result["meta_loss"].item(), rel=1e-5)
        found = [[abs(e) for errors in levels for place, e in errors.items() if place[0] == b] for b in range(B)]
        wanted = [0.9 * max(errors) + 0.1 * sum(errors) / len(errors) if errors else 0.0 for errors in found]
        assert result["priority"].tolist() == pytest.approx(wanted, rel=1e-4)

    def test_the_report_equals_that_of_plain_loops(self):
        loss = make_loss()
        td = play(loss)
        result = loss(td)
        sub, meta = Reference(in_sequences(loss), td).run()
        action_value, subgoal_value, *_ = tables(loss)
        values = [action_value[b * T + t, g, td["action"][b, t]].item() for b, t, g in sub]
        assert set(result.keys()) == set(loss.out_keys)
        assert result["trained_steps"] == len(sub)
        assert result["td_error"].item() == pytest.approx(sum(map(abs, sub.values())) / len(sub), rel=1e-5)
        assert result["meta_td_error"].item() == pytest.approx(sum(map(abs, meta.values())) / len(meta), rel=1e-5)
        assert result["q_value"].item() == pytest.approx(sum(values) / len(sub), rel=1e-4)
        assert result["target"].item() == pytest.approx((sum(values) - sum(sub.values())) / len(sub), rel=1e-4)
        meta_values = [subgoal_value[b * T + t, g].item() for b, t, g in meta]
        assert result["meta_q_value"].item() == pytest.approx(sum(meta_values) / len(meta), rel=1e-4)
        assert [name for name, value in result.items() if value.requires_grad] == ["loss"]

    def test_the_test_sequences_include_every_case(self):
        td = play(make_loss())
        after = td["next"][:, :-1]
        done, terminated = after["done"].squeeze(-1), after["terminated"].squeeze(-1)
        attained = after["attained"]
        pursued = attained.gather(-1, after["active_subgoal"].unsqueeze(-1)).squeeze(-1)
        several = attained.sum(-1) > 1
        for case in (done & ~terminated, terminated & td["subgoal_mask"][:, :-1].any(-1), pursued, several):
            assert case.sum() >= 2
        assert (attained.any(-1) & done & ~terminated).any() and (attained.any(-1) & ~pursued).any()
        inside = ~td["option_init"].squeeze(-1)
        assert inside[:, -1].any() and after["hazard"].any() and td["is_init"].sum() > 2 * B

    @pytest.mark.parametrize("settings", CHANGES, ids=str)
    def test_every_argument_changes_the_loss(self, settings):
        losses = []
        for changed in ({}, settings):
            torch.manual_seed(0)
            loss = make_loss(**changed)
            losses.append(loss(play(loss))["loss"].item())
        assert not math.isclose(*losses, rel_tol=1e-4)


def hand_made(actions, **events):
    """One sequence, one subgoal, two actions; nothing happens but the ``events`` at the times given."""
    steps = len(actions)
    td = TensorDict(observation=torch.arange(steps)[None], batch_size=(1, steps))
    td["action"] = torch.tensor([[int(action) for action in actions]])
    td["previous_action"] = torch.zeros(1, steps, dtype=torch.int64)
    td["is_init"] = td["option_init"] = (torch.arange(steps) == 0).view(1, steps, 1)
    td["subgoal_mask"] = torch.ones(1, steps, 1, dtype=torch.bool)
    no = torch.zeros(1, steps, 1, dtype=torch.bool)
    after = {key: no.clone() for key in ("attained", "hazard", "done", "terminated")}
    after["extrinsic_reward"] = torch.zeros(1, steps, 1)
    after["active_subgoal"] = torch.zeros(1, steps, dtype=torch.int64)
    td["next"] = TensorDict(after, batch_size=(1, steps))
    for key, time in events.items():
        td["next", key][0, time] = 1
    return td


END = {"done": 1, "terminated": 1}


@pytest.mark.parametrize(
    ("actions", "events", "sub", "meta"),
    [
        # Values that follow are 0.8 (sub) and 4 (meta), discounts and lambda 0.5, action 0 is the greedy one.
        # 0.3 = 0.5 (0.5 * 0.8 + 0.5 * 0.4); 0.275 = 0.5 (0.5 * 0.8 + 0.5 * 0.3); 1.5 = 0.5 (0.5 * 4 + 0.5 * 2).
        ("0000", {}, [0.275, 0.3, 0.4], [1.375, 1.5, 2.0]),
        ("0001", {}, [0.275, 0.3, 0.4], [1.375, 1.5, 2.0]),  # the lookahead's action cuts nothing that is taken over
        ("0100", {}, [0.4, 0.3, 0.4], [2.0, 1.5, 2.0]),  # Watkins' cut: the step before an exploratory one
        ("0010", {}, [0.3, 0.4, 0.4], [1.5, 2.0, 2.0]),
        ("0000", {"hazard": 1}, [0.025, -0.7, 0.4], [1.375, 1.5, 2.0]),
        ("0000", {"extrinsic_reward": 1}, [0.275, 0.3, 0.4], [1.625, 2.5, 2.0]),
        ("0000", {"attained": 1, "extrinsic_reward": 1, **END}, [0.45, 1.0, 0.4], [1.25, 1.0, 2.0]),
        ("0000", END, [0.2, 0.0, 0.4], [1.0, 0.0, 2.0]),
        # A time limit is no end: its own step is not trained, and the one before takes the value alone.
        ("0000", {"done": 1}, [0.4, None, 0.4], [2.0, None, 2.0]),
        ("0000", {"done": 1, "attained": 1}, [0.45, 1.0, 0.4], [2.0, None, 2.0]),
        ("0000", {"done": 2}, [0.3, 0.4, None], [1.5, 2.0, None]),
        ("0000", {"done": 2, "terminated": 2}, [0.25, 0.2, 0.0], [1.25, 1.0, 0.0]),
        # An option that ends in mid-episode goes on with the best that is left.
        ("0000", {"attained": 1}, [0.45, 1.0, 0.4], [1.5, 2.0, 2.0]),
        # What the lookahead led to is not read.
        ("0000", {"attained": 3, "hazard": 3, "extrinsic_reward": 3}, [0.275, 0.3, 0.4], [1.375, 1.5, 2.0]),
        ("0000", {"done": 3, "terminated": 3}, [0.275, 0.3, 0.4], [1.375, 1.5, 2.0]),
    ],
)
def test_targets_equal_numbers_computed_by_hand(actions, events, sub, meta):
    loss = make_loss(4, subgoals=1, actions=2, sub_gamma=0.5, meta_gamma=0.5, trace_decay=0.5)
    with torch.no_grad():
        for table, value in zip(tables(loss), ([1.0, 0.0], [0.0], [0.8, 8.0], [4.0]), strict=True):
            table.copy_(torch.tensor(value).expand_as(table))
    loss(hand_made(actions, **events))["loss"].backward()
    action_value, subgoal_value, *_ = tables(loss)
    values = [1.0 - int(action) for action in actions]
    check_gradient(action_value.grad.sum((1, 2)), values, sub)
    check_gradient(subgoal_value.grad.sum(1), [0.0] * 4, meta)


@pytest.mark.parametrize(
    ("real", "events", "sub", "meta"),
    [
        # As above, for the steps that are real; what the last one led to is not in the sequence.
        (3, {}, [0.3, 0.4, None], [1.5, 2.0, None]),
        (3, {"done": 2, "terminated": 2}, [0.25, 0.2, 0.0], [1.25, 1.0, 0.0]),
        (3, {"attained": 2}, [0.3125, 0.45, 1.0], [1.5, 2.0, None]),
        (2, END, [0.2, 0.0], [1.0, 0.0]),
        (2, {"done": 1}, [0.4, None], [2.0, None]),
        (2, {"hazard": 0}, [-0.6, None], [2.0, None]),
        (1, {}, [None], [None]),
        (1, {"done": 0, "terminated": 0, "attained": 0}, [1.0], [0.0]),
    ],
)
def test_targets_of_padded_sequences_equal_numbers_computed_by_hand(real, events, sub, meta):
    loss = make_loss(4, subgoals=1, actions=2, sub_gamma=0.5, meta_gamma=0.5, trace_decay=0.5)
    with torch.no_grad():
        for table, value in zip(tables(loss), ([1.0, 0.0], [0.0], [0.8, 8.0], [4.0]), strict=True):
            table.copy_(torch.tensor(value).expand_as(table))
    td = hand_made("0000", **events)
    td = td[:, torch.arange(4).clamp(max=real - 1)].contiguous()
    td["collector", "mask"] = (torch.arange(4) < real)[None]
    td["observation"] = torch.arange(4)[None]  # entries of their own, so that padding shows if it is trained
    result = loss(td)
    result["loss"].backward()
    errors = [abs(1 - y) for y in sub if y is not None] + [abs(y) for y in meta if y is not None]
    priority = 0.9 * max(errors) + 0.1 * sum(errors) / len(errors) if errors else 0.0
    assert result["priority"].item() == pytest.approx(priority)
    action_value, subgoal_value, *_ = tables(loss)
    nothing = [None] * (3 - real)
    check_gradient(action_value.grad.sum((1, 2)), [1.0] * 4, sub + nothing)
    check_gradient(subgoal_value.grad.sum(1), [0.0] * 4, meta + nothing)


def check_gradient(grad, values, targets):
    """2 (value - target) / count where there is a target, else 0; 0 for the lookahead."""
    count = max(1, sum(target is not None for target in targets))
    errors = [0.0 if y is None else value - y for value, y in zip(values, targets, strict=False)]
    assert grad.tolist() == pytest.approx([2 * error / count for error in errors] + [0.0], abs=1e-6)


class TestInTheEnvironment:
    """With a real network, on sequences from a replay memory of real play."""

    def sample(self, settings=None, **options):
        torch.manual_seed(0)
        env = small_env(8, max_steps=6, view=5)
        usual = {"sampling": "episode_starts", "slice_len": 10, "batch_size": 32, "learning_rate": 1e-2}
        settings = tiny_settings(**(usual | (settings or {})))
        usual = {"memory_size": 8, "head_size": 8, "prediction_steps": 0, "sub_gamma": 0.95, "meta_gamma": 0.97}
        algorithm = make_v3(env, compact_network(16, (16,)), learner=settings, **(usual | PENALTY | options))
        self.learner = algorithm.learners["joint"]
        for batch in collect(algorithm, env, 20, batches=2):
            self.learner.store(batch)
        for _ in range(6):  # values that differ, and a target that lags behind
            self.learner.update(self.learner.sample())
        self.learner.optimizer.zero_grad()
        return self.learner.loss, self.learner.sample()

    def values(self, loss, td):
        """Q-values by the main and the target network, ``[B, T, G, A]`` and ``[B, T, G]`` each."""
        with torch.no_grad():
            pairs = loss._values(td)[:2]
        return [part for sub, meta in pairs for part in (sub, meta.squeeze(-2))]

    @pytest.mark.parametrize(
        "settings",
        [
            {"sampling": "episode_starts"},
            {"sampling": "whole_episodes"},
            {"sampling": "steps", "stored_state": True, "burn_in": 0.0},
            {"sampling": "steps", "stored_state": True, "burn_in": 0.2, "slice_len": 6, "batch_size": 64},
            {"sampling": "episodes", "stored_state": True, "burn_in": 0.4, "slice_len": 3, "batch_size": 64},
        ],
        ids=str,
    )
    @pytest.mark.parametrize("options", [{}, {"max_option_steps": 2, "trace_decay": 1.0}], ids=str)
    def test_losses_equal_those_of_plain_loops_on_collected_steps(self, options, settings):
        loss, td = self.sample(settings, **options)
        result = loss(td)
        padded = not td.get(("collector", "mask"), torch.tensor(True)).all()
        assert padded == (settings["sampling"] != "episode_starts")
        assert td["is_init"][:, 0].all() != settings.get("stored_state", False)
        others = {"burn_in": settings.get("burn_in", 0.5), "trace_decay": options.get("trace_decay", 0.8)}
        assert (loss.lookahead > 1) == (settings["sampling"] in ("steps", "episodes"))
        sub, meta = Reference(self.values(loss, td), td, lookahead=loss.lookahead, **others).run()
        assert result["trained_steps"] == len(sub) > 100 and len(meta) > 50
        assert result["sub_loss"].item() == pytest.approx(mean_square(sub), rel=1e-4)
        assert result["meta_loss"].item() == pytest.approx(mean_square(meta), rel=1e-4)

    def test_targets_have_no_gradient(self):
        """The reference differentiates only the values, not the targets."""
        loss, td = self.sample()
        sub, meta = Reference(self.values(loss, td), td).run()
        network = self.learner.network.network
        loss(td)["loss"].backward()
        found = {name: p.grad.clone() for name, p in network.named_parameters()}
        network.zero_grad()
        inputs = (td["observation"], td["previous_action"], td["is_init"].squeeze(-1), [td["subgoal_mask"]])
        (action_value, subgoal_value), _ = network.unroll(*inputs)
        subgoal_value = subgoal_value.squeeze(-2)
        total = 0.0
        for (b, t, g), error in sub.items():
            total = total + 2 * error / len(sub) * action_value[b, t, g, td["action"][b, t]]
        for (b, t, g), error in meta.items():
            total = total + 2 * error / len(meta) * subgoal_value[b, t, g]
        total.backward()
        for name, parameter in network.named_parameters():
            torch.testing.assert_close(found[name], parameter.grad, rtol=1e-3, atol=1e-6)
        assert all(not p.requires_grad for p in loss.target_policy_params.values(True, True))

    @pytest.mark.parametrize("joint", [True, False])
    def test_the_meta_loss_reaches_the_memory_only_if_joint(self, joint):
        loss, td = self.sample(joint=joint)
        network = self.learner.network.network
        with torch.no_grad():
            network.sub_head[2].weight.zero_()  # no way to the memory through the sub level
        loss(td)["loss"].backward()
        moved = {name for name, p in network.named_parameters() if p.grad is not None and (p.grad != 0).any()}
        assert any(name.startswith(("memory", "features")) for name in moved) == joint
        assert {"meta_head.0.weight", "sub_head.2.bias"} <= moved

    @pytest.mark.parametrize("sampling", ["episode_starts", "whole_episodes"])
    def test_predictions_within_an_episode_enter_the_loss_and_train_the_memory(self, sampling):
        loss, td = self.sample({"sampling": sampling}, prediction_steps=3, prediction_weight=0.5)
        valid = loss._valid(td)
        network, seen = self.learner.network.network, set()
        rows, steps = td.shape
        for seed in range(8):
            torch.manual_seed(seed)
            ahead = int(torch.randint(1, 4, ()))
            torch.manual_seed(seed)
            result = loss(td)
            with torch.no_grad():
                memory = loss._values(td)[2]
                errors = network.predictor(memory, td["action"], td["observation"], steps=ahead)
            kept = [
                errors[b, t].item()
                for b, t in product(range(rows), range(steps - ahead))
                if valid[b, t + ahead] and not td["is_init"][b, t + 1 : t + ahead + 1].any()
            ]
            assert 0 < len(kept) < errors.numel()
            assert result["prediction_loss"].item() == pytest.approx(sum(kept) / len(kept), rel=1e-4)
            parts = (result["sub_loss"] + result["meta_loss"] + 0.5 * result["prediction_loss"]).item()
            assert result["loss"].item() == pytest.approx(parts, rel=1e-5)
            seen.add(ahead)
        assert seen == {1, 2, 3} and set(result.keys()) == set(loss.out_keys)
        with torch.no_grad():
            for head in (network.sub_head[2], network.meta_head[2]):
                head.weight.zero_()  # no way to the memory through the values
        loss(td)["loss"].backward()
        assert all((p.grad != 0).any() for p in network.memory.parameters())

    def test_a_predictor_with_weight_zero_is_not_run(self):
        loss, td = self.sample(prediction_steps=3, prediction_weight=0.0)
        assert "prediction_loss" not in loss(td) and "prediction_loss" not in loss.out_keys

    def test_both_networks_start_from_the_stored_state(self):
        loss, td = self.sample({"stored_state": True, "sampling": "steps"})
        before = self.values(loss, td)
        middle = ~td["is_init"][:, 0].squeeze(-1)
        assert middle.sum() > 8 and (~middle).sum() > 2
        td["memory_hidden"][:, 0] += 1.0
        for old, new in zip(before, self.values(loss, td), strict=True):
            assert (old[middle] != new[middle]).flatten(1).any(1).all()
            assert (old[~middle] == new[~middle]).all()
        td["memory_hidden"][:, 1:] = math.nan  # only the first one is read
        assert all(torch.isfinite(value).all() for value in self.values(loss, td))

    def test_only_the_updater_changes_the_target_network(self):
        loss, td = self.sample()
        before = loss.target_policy_params.data.clone()
        loss(td)["loss"].backward()
        self.learner.optimizer.step()
        assert parameter_distance(before, loss.target_policy_params.data) == 0
        self.learner.target_updater.step()
        tau = self.learner.settings.tau
        for key, weight in loss.policy_params.items(True, True):
            if weight.requires_grad:
                moved = before[key].lerp(weight, tau)
                torch.testing.assert_close(loss.target_policy_params[key], moved, rtol=0, atol=1e-6)
        assert parameter_distance(before, loss.target_policy_params.data) > 0

    @pytest.mark.parametrize("stored_state", [False, True])
    @pytest.mark.parametrize("hazard_reward", [-1.0, 0.0])
    def test_the_loss_reads_in_keys_and_nothing_else(self, hazard_reward, stored_state):
        settings = {"stored_state": True, "sampling": "steps", "burn_in": 0.0} if stored_state else {}
        loss, td = self.sample(settings, hazard_reward=hazard_reward, intra_option=False)
        td = td.exclude(("collector", "mask"))
        whole, needed = loss(td), td.select(*loss.in_keys)
        assert len(needed.keys(True, True)) == len(loss.in_keys) == 12 - (hazard_reward == 0.0) + 2 * stored_state
        assert loss(needed)["loss"] == whole["loss"]
        for key in loss.in_keys:
            with pytest.raises(KeyError):
                loss(needed.exclude(key))

    def test_all_keys_can_be_renamed_and_nested(self):
        loss, td = self.sample()
        expected = loss(td)["loss"]
        td["agent_action", "x"] = td.pop("action")
        for key in ("hazard", "extrinsic_reward", "done", "terminated"):
            td["next", f"agent_{key}", "x"] = td["next"].pop(key)
        moved = {key: (f"agent_{key}", "x") for key in ("action", "hazard", "extrinsic_reward", "done", "terminated")}
        loss.set_keys(**moved)
        assert loss(td)["loss"] == expected


def test_all_outputs_of_the_loss_are_on_the_device_of_the_sample():
    """Mixing devices raises an error."""
    loss = make_loss()
    td = play(loss).to("meta")
    loss = AllSubgoalsLoss(AllSubgoalsPolicy(Tables(B * T)).to("meta"), max_meta_target=1.0)
    assert loss(td)["loss"].device.type == "meta"


def test_sequences_without_trained_steps_have_zero_loss():
    """If time limits cut off every step, the loss is 0 and not NaN."""
    loss = make_loss()
    td = play(loss)
    td["next", "done"][:], td["next", "terminated"][:], td["next", "attained"][:] = True, False, False
    result = loss(td)
    assert result["loss"] == 0 and result["trained_steps"] == 0
    assert all(torch.isfinite(value).all() for value in result.values())


@pytest.mark.parametrize("name", ["sub_gamma", "meta_gamma", "trace_decay"])
@pytest.mark.parametrize("value", [-0.1, 1.1])
def test_wrong_arguments_are_refused(name, value):
    with pytest.raises(ValueError, match=rf"{name} must lie in \[0, 1\], got {value}; "):
        make_loss(**{name: value})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"lookahead": 0}, r"lookahead must be >= 1 step, got 0; "),
        ({"middle_gamma": 2.0}, r"middle_gamma must lie in \[0, 1\], got 2.0; "),
        ({"wrong_subgoal_reward": [0.0, -0.5]}, r"wrong_subgoal_reward must be one number, or one for each of 1 sets"),
        ({"burn_in": 1.0}, r"burn_in must lie in \[0, 1\), got 1.0; "),
        ({"loss_function": "l1"}, "loss_function must be 'l2' or 'smooth_l1', got 'l1'; "),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        make_loss(**settings)
