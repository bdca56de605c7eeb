"""The loss of v3 with one to four levels, on tables of values, compared with its written rule in plain loops."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from hdrqn_torchrl.keys import OptionKeys
from hdrqn_torchrl.modules import AllSubgoalsPolicy
from hdrqn_torchrl.objectives import AllSubgoalsLoss

B, T, ACTIONS = 10, 16, 3
SETS = {"near": 4, "middle": 3, "": 2}  # prefixes and sizes, from near to far
SETTINGS = {
    "sub_gamma": 0.9,
    "middle_gamma": 0.93,
    "meta_gamma": 0.97,
    "trace_decay": 0.8,
    "hazard_reward": -0.7,
    "wrong_subgoal_reward": -0.5,
    "double": True,
    "all_subgoals": True,
    "intra_option": True,
}


class Tables(nn.Module):
    """A "network" whose values are free parameters, ``[steps, C, X]`` for each level; observations number the steps."""

    hidden_size, predictor = 1, None

    def __init__(self, sizes, actions=ACTIONS, steps=B * T):
        super().__init__()
        self.num_subgoals, self.num_actions = tuple(sizes), actions
        shapes = zip([*sizes, 1], [actions, *sizes], strict=True)
        self.values = nn.ParameterList(torch.randn(steps, conditions, choices) for conditions, choices in shapes)

    def unroll(self, observation, previous_action, init, masks, state=None):
        return tuple(table[observation] for table in self.values), observation


def make_loss(levels, *, action_mask_key=None, **settings):
    prefixes = list(SETS)[len(SETS) - (levels - 1) :]
    names = [OptionKeys(prefix) for prefix in prefixes]
    loss = AllSubgoalsLoss(
        AllSubgoalsPolicy(
            Tables([SETS[prefix] for prefix in prefixes]), subgoal_keys=names, action_mask_key=action_mask_key
        ),
        **(SETTINGS | {"wrong_subgoal_reward": [SETTINGS["wrong_subgoal_reward"]] * (levels - 1)} | settings),
    )
    with torch.no_grad():
        for value in loss.target_policy_params.values(True, True):
            if value.is_floating_point() and value.numel() > 1:
                value.copy_(torch.randn_like(value))
    return loss, names


def tables(loss):
    """Of the main and of the target network, one for each level."""
    return [[params["network", "values", str(level)] for level in range(len(loss.rules))]
            for params in (loss.policy_params, loss.target_policy_params)]  # fmt: skip


def play(loss, names, seed=0):
    """Random sequences: subgoals of every set are attained now and then, options of a set end with those above."""
    generator = torch.Generator().manual_seed(seed)

    def chance(probability):
        return torch.rand((), generator=generator).item() < probability

    def pick(options):
        return options[int(torch.randint(len(options), (), generator=generator))]

    rows = []
    for b in range(B):
        row, fresh, starts, active = [], True, {}, {}
        for t in range(T):
            now = {"observation": b * T + t, "is_init": fresh, "action": pick(range(ACTIONS)), "hazard": chance(0.1)}
            if chance(0.7):  # mostly the greedy action for some nearest subgoal
                now["action"] = tables(loss)[0][0][b * T + t][0].argmax().item()
            above_starts = fresh
            for each in reversed(names):
                starts[each] = fresh or above_starts or starts.get(each, True)
                mask = [chance(0.8) for _ in range(SETS[each.prefix])]
                mask = [False] * len(mask) if chance(0.1) else mask
                if starts[each]:
                    active[each] = pick([index for index, left in enumerate(mask) if left or not any(mask)])
                now[each.option_init], now[each.subgoal_mask] = starts[each], mask
                now["next " + each.active_subgoal] = active[each]
                now["next " + each.attained] = [chance(0.15) for _ in mask]
                above_starts = starts[each]
            now |= {"terminated": chance(0.06), "extrinsic_reward": pick([0.0, 0.01, 1.0])}
            now["done"] = now["terminated"] or chance(0.06)
            starts = {each: now["next " + each.attained][active[each]] or chance(0.1) for each in names}
            fresh = now["done"]
            row.append(now)
        rows.append(row)
    td = TensorDict(
        {key: torch.tensor([[step[key] for step in row] for row in rows]) for key in rows[0][0]}, batch_size=(B, T)
    )
    for key in ("is_init", "hazard", "done", "terminated", "extrinsic_reward", *(each.option_init for each in names)):
        td[key] = td[key].unsqueeze(-1)
    below = [key for key in sorted(td.keys()) if key.startswith("next ")]
    after = {key.removeprefix("next "): td[key] for key in below}
    after |= {key: td[key] for key in ("hazard", "done", "terminated", "extrinsic_reward")}
    after["reward"] = after["extrinsic_reward"]
    td = td.exclude(*below)
    td["previous_action"] = torch.zeros(B, T, dtype=torch.int64)
    return td.set("next", TensorDict(after, batch_size=(B, T)))


class Reference:
    """The rule of the module's docstring: level by level, step by step, subgoal by subgoal."""

    def __init__(self, loss, names, td, **settings):
        self.s, self.names, self.td = SETTINGS | settings, names, td
        self.masked = "action_mask" in td.keys()  # noqa: SIM118
        self.q, self.target = tables(loss)
        self.levels = len(names) + 1
        self.sizes = [ACTIONS, *(SETS[each.prefix] for each in names)]
        self.conditions = [*self.sizes[1:], 1]

    def flag(self, key, b, t, root=False):
        return bool((self.td if root else self.td["next"])[key][b, t])

    def cut_off(self, b, t):
        return self.flag("done", b, t) and not self.flag("terminated", b, t)

    def allowed(self, level, b, t):
        """Choices that there are; all, where there are none."""
        if level == 0:
            return self.td["action_mask"][b, t].nonzero().flatten().tolist() if self.masked else list(range(ACTIONS))
        left = self.td[self.names[level - 1].subgoal_mask][b, t].nonzero().flatten().tolist()
        return left or list(range(self.sizes[level]))

    def best(self, values, level, c, b, t):
        return max(self.allowed(level, b, t), key=lambda x: values[level][b * T + t, c, x].item())

    def attained(self, level, x, b, t):
        """Whether choice x of a level was attained in a step; actions always are."""
        return level == 0 or bool(self.td["next", self.names[level - 1].attained][b, t, x])

    def lost(self, level, x, b, t):
        """Whether choice x of a level can't be chosen after a step any more, though it was not attained."""
        gone = level > 0 and not self.td[self.names[level - 1].subgoal_mask][b, t + 1, x]
        return gone and not self.attained(level, x, b, t)

    def over(self, level, x, b, t):
        return self.attained(level, x, b, t) or self.lost(level, x, b, t)

    def agrees(self, level, x, b, t):
        """Whether choice x of a level agrees with a step."""
        if level == 0:
            return self.td["action"][b, t].item() == x
        return self.agrees(level - 1, self.best(self.q, level - 1, x, b, t), b, t)

    def pursued(self, level, x, b, t):
        return self.td["next", self.names[level - 1].active_subgoal][b, t].item() == x

    def reward(self, level, c, b, t):
        if level == self.levels - 1:
            return self.td["next", "extrinsic_reward"][b, t].item()
        attained = self.td["next", self.names[level].attained][b, t]
        reward = float(attained[c])
        reward += self.s["wrong_subgoal_reward"] * bool(attained.sum() > attained[c])
        return reward + self.s["hazard_reward"] * self.flag("hazard", b, t)

    def ends(self, level, c, b, t):
        over = level < self.levels - 1 and (
            self.attained(level + 1, c, b, t) or (self.lost(level + 1, c, b, t) and not self.cut_off(b, t))
        )
        return self.flag("terminated", b, t) or over

    def gamma(self, level):
        if level == 0:
            return self.s["sub_gamma"]
        return self.s["meta_gamma" if level == self.levels - 1 else "middle_gamma"]

    def value(self, level, c, x, b, t):
        """U at step ``t``, which followed a step that did or did not attain or lose x."""
        chooser = self.q if self.s["double"] else self.target
        if self.over(level, x, b, t - 1):
            x = self.best(chooser, level, c, b, t)
        return self.target[level][b * T + t, c, x].item()

    def unknown(self, level, c, b, t):
        return self.cut_off(b, t) and not self.ends(level, c, b, t)

    def y(self, level, c, x, b, t):
        reward = self.reward(level, c, b, t)
        if self.ends(level, c, b, t):
            return reward
        value = self.value(level, c, x, b, t + 1)
        lasts = level == 0 or not self.over(level, x, b, t)
        if lasts and t + 1 < T - 1 and not self.unknown(level, c, b, t + 1):
            # At level 0 "the next action is the greedy one for c"; above "the next step is what x would do".
            follower = self.best(self.q, 0, c, b, t + 1) if level == 0 else x
            if self.agrees(level, follower, b, t + 1):
                decay = self.s["trace_decay"]
                value = (1 - decay) * value + decay * self.y(level, c, follower, b, t + 1)
        return reward + self.gamma(level) * value

    def trained(self, level, c, x, b, t):
        if level < self.levels - 1:
            allowed = bool(self.td[self.names[level].subgoal_mask][b, t, c])
            if not allowed or (not self.s["all_subgoals"] and not self.pursued(level + 1, c, b, t)):
                return False
        if self.unknown(level, c, b, t):
            return False
        if level == 0:
            return self.agrees(0, x, b, t)
        pursued = self.pursued(level, x, b, t)
        learns = pursued or (self.s["all_subgoals"] and self.agrees(level, x, b, t))
        return x in self.allowed(level, b, t) and learns

    def errors(self, level):
        largest = math.inf
        if level < self.levels - 1 and max(self.s["wrong_subgoal_reward"], self.s["hazard_reward"]) <= 0:
            largest = 1.0
        return {
            (b, t, c, x): self.q[level][b * T + t, c, x].item() - min(self.y(level, c, x, b, t), largest)
            for b in range(B)
            for t in range(T - 1)
            for c in range(self.conditions[level])
            for x in range(self.sizes[level])
            if self.trained(level, c, x, b, t)
        }


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("levels", [1, 2, 3, 4])
@pytest.mark.parametrize(
    "settings", [{}, {"trace_decay": 0.0}, {"trace_decay": 1.0}, {"double": False}, {"all_subgoals": False}], ids=str
)
def test_errors_masks_and_gradients_of_every_level_equal_a_brute_force_reference(levels, settings, masked):
    torch.manual_seed(levels)
    loss, names = make_loss(levels, action_mask_key="action_mask" if masked else None, **settings)
    td = play(loss, names, seed=levels)
    if masked:
        taken = td["action"].unsqueeze(-1) == torch.arange(ACTIONS)
        td["action_mask"] = taken | (torch.rand(B, T, ACTIONS) < 0.5)
    result = loss(td.clone())
    result["loss"].backward()
    reference, total = Reference(loss, names, td, **settings), 0.0
    for level, rule in enumerate(loss.rules):
        errors = reference.errors(level)
        wanted = sum(error**2 for error in errors.values()) / len(errors)
        assert len(errors) > 30 and result[f"{rule.name}_loss"].item() == pytest.approx(wanted, rel=1e-4)
        gradient = torch.zeros_like(tables(loss)[0][level])
        for (b, t, c, x), error in errors.items():
            gradient[b * T + t, c, x] = 2 * error / len(errors)
        torch.testing.assert_close(tables(loss)[0][level].grad, gradient, rtol=1e-3, atol=1e-6)
        total += wanted
    assert result["loss"].item() == pytest.approx(total, rel=1e-4)
    assert set(result.keys()) == set(loss.out_keys)


def test_figures_are_named_after_their_level():
    loss, _ = make_loss(4)
    assert [rule.name for rule in loss.rules] == ["sub", "near", "middle", "meta"]
    assert {"sub_loss", "near_loss", "middle_td_error", "meta_q_value", "td_error", "q_value"} <= set(loss.out_keys)


def test_each_set_has_its_own_penalty():
    loss, _ = make_loss(4, wrong_subgoal_reward=[0.0, -0.25, -0.5])
    assert [rule.rewards.wrong_subgoal for rule in loss.rules[:-1]] == [0.0, -0.25, -0.5]
    loss, _ = make_loss(4, wrong_subgoal_reward=-0.25)  # nearer subgoals are passed on the way
    assert [rule.rewards.wrong_subgoal for rule in loss.rules[:-1]] == [0.0, 0.0, -0.25]
    with pytest.raises(ValueError, match=r"wrong_subgoal_reward must be one number, or one for each of 3 sets"):
        make_loss(4, wrong_subgoal_reward=[0.0])


def test_bounds_that_leave_nothing_between_them_are_refused():
    with pytest.raises(ValueError, match=r"max_meta_target must be >= min_meta_target=0.0, got -1.0"):
        make_loss(2, min_meta_target=0.0, max_meta_target=-1.0)


def three_levels(actions, **events):
    """One sequence of one episode; one near and one far subgoal, two actions; nothing happens but the events."""
    near, far = OptionKeys("near"), OptionKeys()
    steps = len(actions)
    no, yes = torch.zeros(1, steps, 1, dtype=torch.bool), torch.ones(1, steps, 1, dtype=torch.bool)
    td = TensorDict(observation=torch.arange(steps)[None], batch_size=(1, steps))
    td["action"] = torch.tensor([[int(action) for action in actions]])
    td["previous_action"] = torch.zeros(1, steps, dtype=torch.int64)
    td["is_init"] = (torch.arange(steps) == 0).view(1, steps, 1)
    after = {key: no.clone() for key in ("hazard", "done", "terminated")}
    after["extrinsic_reward"] = torch.zeros(1, steps, 1)
    for each in (near, far):
        td[each.option_init], td[each.subgoal_mask] = td["is_init"].clone(), yes.clone()
        after[each.attained], after[each.active_subgoal] = no.clone(), torch.zeros(1, steps, dtype=torch.int64)
    td["next"] = TensorDict(after, batch_size=(1, steps))
    for key, time in events.items():
        td["next", key][0, time] = 1
    return td, (near, far)


@pytest.mark.parametrize(
    ("actions", "events", "sub", "middle", "meta"),
    [
        # Values that follow: 0.8 (sub), 0.6 (middle), 4 (meta); discounts and lambda are 0.5; action 0 is greedy.
        # sub: 0.5 * 0.8 = 0.4; 0.5 (0.5 * 0.8 + 0.5 * 0.4) = 0.3. middle: 0.3, 0.225. meta: 2, 1.5.
        ("000", {}, [0.3, 0.4], [0.225, 0.3], [1.5, 2.0]),
        ("010", {}, [0.4, 0.4], [0.3, 0.3], [2.0, 2.0]),  # an exploratory action cuts the traces of all levels
        # The near subgoal attained: the sub level is paid and ends, the middle level goes on with its best choice.
        ("000", {"near_attained": 0}, [1.0, 0.4], [0.3, 0.3], [1.5, 2.0]),
        # The far one attained: the middle level is paid and ends; the near option knows nothing of it.
        ("000", {"attained": 0}, [0.3, 0.4], [1.0, 0.3], [2.0, 2.0]),
        ("000", {"attained": 1}, [0.3, 0.4], [0.5 * (0.5 * 0.6 + 0.5 * 1.0), 1.0], [1.5, 2.0]),
        ("000", {"hazard": 1}, [0.5 * (0.4 - 0.3), -0.6], [0.5 * (0.3 - 0.35), -0.7], [1.5, 2.0]),
        ("000", {"extrinsic_reward": 1}, [0.3, 0.4], [0.225, 0.3], [1.75, 3.0]),
        ("000", {"done": 1, "terminated": 1}, [0.2, 0.0], [0.15, 0.0], [1.0, 0.0]),
        ("000", {"done": 1}, [0.4, None], [0.3, None], [2.0, None]),  # a time limit: what follows is not seen
        ("000", {"done": 1, "attained": 1}, [0.4, None], [0.4 * 0 + 0.5 * (0.3 + 0.5), 1.0], [2.0, None]),
    ],
)
def test_targets_of_three_levels_equal_numbers_computed_by_hand(actions, events, sub, middle, meta):
    td, names = three_levels(actions, **events)
    loss = AllSubgoalsLoss(
        AllSubgoalsPolicy(Tables([1, 1], actions=2, steps=3), subgoal_keys=names),
        sub_gamma=0.5,
        meta_gamma=0.5,
        trace_decay=0.5,
    )
    main, target = tables(loss)
    with torch.no_grad():
        for table, values in zip([*main, *target], ([1.0, 0.0], [0.0], [0.0], [0.8, 8.0], [0.6], [4.0]), strict=True):
            table.copy_(torch.tensor(values).expand_as(table))
    loss(td)["loss"].backward()
    values = ([1.0 - int(action) for action in actions], [0.0] * 3, [0.0] * 3)
    for table, value, wanted in zip(main, values, (sub, middle, meta), strict=True):
        count = sum(y is not None for y in wanted)
        errors = [0.0 if y is None else now - y for now, y in zip(value, wanted, strict=False)]
        gradient = [2 * error / count for error in errors] + [0.0]
        assert table.grad.sum((1, 2)).tolist() == pytest.approx(gradient, abs=1e-6)


def test_targets_count_on_no_action_that_cannot_be_chosen():
    """As in the row "000" above, but the second step has action 1 only: it is worth 0.2, and greedy as it is alone."""
    td, names = three_levels("010")
    td["action_mask"] = torch.tensor([[[True, True], [False, True], [True, True]]])
    policy = AllSubgoalsPolicy(Tables([1, 1], actions=2, steps=3), subgoal_keys=names, action_mask_key="action_mask")
    loss = AllSubgoalsLoss(policy, sub_gamma=0.5, meta_gamma=0.5, trace_decay=0.5)
    main, target = tables(loss)
    with torch.no_grad():
        for table, values in zip([*main, *target], ([1.0, 0.0], [0.0], [0.0], [0.8, 0.2], [0.6], [4.0]), strict=True):
            table.copy_(torch.tensor(values).expand_as(table))
    loss(td)["loss"].backward()
    wanted = [[0.5 * (0.5 * 0.2 + 0.5 * 0.4), 0.4], [0.225, 0.3], [1.5, 2.0]]
    for table, value, targets in zip(main, ([1.0, 0.0], [0.0, 0.0], [0.0, 0.0]), wanted, strict=True):
        gradient = [now - y for now, y in zip(value, targets, strict=True)] + [0.0]
        assert table.grad.sum((1, 2)).tolist() == pytest.approx(gradient, abs=1e-6)


@pytest.mark.parametrize(
    ("lost", "sub", "middle", "meta"),
    [
        # After the first step the near subgoal can't be pursued: that step is worth nothing for it. The second is not
        # trained for it, nor for the middle level's choosing it; that chooses the other one: 0.5 * 0.9.
        ("near", [0.0, None], [0.5 * 0.9, None], [1.5, 2.0]),
        ("", [0.3, 0.4], [0.0, None], [0.5 * 5.0, None]),
    ],
)
def test_an_option_whose_subgoal_is_lost_is_followed_by_the_best_that_is_left(lost, sub, middle, meta):
    """Two subgoals of each set, of which the second is never pursued; as in the row "000" above otherwise."""
    td, names = three_levels("000")
    for each in names:
        td[each.subgoal_mask] = torch.ones(1, 3, 2, dtype=torch.bool)
        td["next", each.attained] = torch.zeros(1, 3, 2, dtype=torch.bool)
    td[OptionKeys(lost).subgoal_mask][0, 1, 0] = False
    policy = AllSubgoalsPolicy(Tables([2, 2], actions=2, steps=3), subgoal_keys=names)
    loss = AllSubgoalsLoss(policy, sub_gamma=0.5, meta_gamma=0.5, trace_decay=0.5, all_subgoals=False)
    main, target = tables(loss)
    values = ([1.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.8, 8.0], [0.6, 0.9], [4.0, 5.0])
    with torch.no_grad():
        for table, value in zip([*main, *target], values, strict=True):
            table.copy_(torch.tensor(value).expand_as(table))
    loss(td)["loss"].backward()
    for table, value, wanted in zip(main, (1.0, 0.0, 0.0), (sub, middle, meta), strict=True):
        count = max(1, sum(y is not None for y in wanted))
        gradient = [0.0 if y is None else 2 * (value - y) / count for y in wanted] + [0.0]
        assert table.grad[:, 0, 0].tolist() == pytest.approx(gradient, abs=1e-6)


class TestFlat:
    """One level: the same memory and loss without hierarchy."""

    def test_a_bonus_for_subgoals_is_added_to_the_task_s_reward(self):
        torch.manual_seed(0)
        loss, names = make_loss(1, bonus_reward=0.5)
        td = play(loss, names)
        td["next", "attained"] = torch.rand(B, T, 3) < 0.3
        bonus = td.clone()
        bonus["next", "extrinsic_reward"] += 0.5 * td["next", "attained"].sum(-1, keepdim=True)
        plain = AllSubgoalsLoss(loss._networks[0], **(SETTINGS | {"wrong_subgoal_reward": []}))
        plain.target_policy_params.data.update_(loss.target_policy_params.data)
        assert loss(td)["loss"].item() == pytest.approx(plain(bonus)["loss"].item(), rel=1e-6)
        assert loss(td)["loss"].item() != pytest.approx(plain(td)["loss"].item(), rel=1e-3)
