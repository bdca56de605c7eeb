from copy import deepcopy
from operator import attrgetter
from types import SimpleNamespace

import pytest
import torch
from helpers import build, collect, parameter_distance, small_env, tiny_settings, unroll_by_steps
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch.nn import functional
from torchrl.modules import LSTMModule, set_recurrent_mode
from torchrl.objectives import SoftUpdate

from hdrqn_torchrl.modules import FullyConnectedFeatures, MetaController, QNetwork, SubController
from hdrqn_torchrl.objectives import RecurrentDQNLoss

NAN = float("nan")
BATCH, TIME, SIZE, ACTIONS = 6, 5, 3, 4
SUB_KEYS = {
    "reward": "intrinsic_reward",
    "done": "option_done",
    "terminated": "option_terminated",
    "init": "option_init",
}
META_KEYS = {
    "action_value": "subgoal_value",
    "action": "subgoal",
    "reward": "option_return",
    "steps": "option_steps",
    "action_mask": "subgoal_mask",
}


def make_controller(level="flat", *, recurrent=True):
    conditions = 2 if level == "sub" else 0
    features = FullyConnectedFeatures(SIZE, (7,))
    settings = {"num_actions": ACTIONS, "hidden_size": 6, "num_conditions": conditions, "recurrent": recurrent}
    network = QNetwork(features, **settings).double()
    if level == "meta":
        return MetaController(network)
    if level == "sub":
        return SubController(network)
    return SubController(network, subgoal_key=None, init_key="is_init")


def make_loss(level="flat", *, recurrent=True, **settings):
    """A loss whose target network differs from the main one."""
    torch.manual_seed(0)
    controller = make_controller(level, recurrent=recurrent)
    loss = RecurrentDQNLoss(controller, **({"gamma": 0.9} | settings))
    loss.set_keys(**{"flat": {}, "sub": SUB_KEYS, "meta": META_KEYS}[level])
    with torch.no_grad():
        for parameter in target_parameters(loss, controller.network):
            parameter.add_(0.3 * torch.randn_like(parameter))
    return loss, controller.network


def target_parameters(loss, network):
    """Parameters of the target network, in the order of those of the main network."""
    names = [name for name, _ in network.named_parameters()]
    return [loss.target_value_network_params[("network", *name.split("."))] for name in names]


def target_of(loss, network):
    """The target network as a network of its own."""
    copy = deepcopy(network)
    with torch.no_grad():
        for parameter, value in zip(copy.parameters(), target_parameters(loss, network), strict=True):
            parameter.copy_(value)
    return copy


def make_sample(seed=0, *, padded=True):
    """Sequences ``[B, T]`` as the replay memory gives them, for all three levels at once.

    Row 0 is a whole sequence, row 1 starts an episode, row 2 has two options, the first cut by its time limit,
    row 3 has one that terminates; rows 4 and 5 are shorter if ``padded`` (their last step is repeated).
    """
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(BATCH, TIME, *shape, generator=generator, dtype=torch.double)  # noqa: E731
    flag = lambda: torch.zeros(BATCH, TIME, 1, dtype=torch.bool)  # noqa: E731
    stream = torch.randn(BATCH, TIME + 1, SIZE, generator=generator, dtype=torch.double)
    sample = TensorDict({}, [BATCH, TIME])
    sample["observation"] = stream[:, :-1]
    sample["action"] = torch.randint(ACTIONS, (BATCH, TIME), generator=generator)
    sample["subgoal"] = torch.randint(2, (BATCH, 1), generator=generator).repeat(1, TIME)
    sample["is_init"], sample["option_init"] = flag(), flag()
    sample["is_init"][1, 0] = sample["option_init"][1, 0] = True
    sample["option_init"][2, 2] = sample["option_init"][3, 3] = True
    after = TensorDict({}, [BATCH, TIME])
    after["observation"], after["subgoal"] = stream[:, 1:], sample["subgoal"]
    for key in ("reward", "intrinsic_reward", "option_return"):
        after[key] = draw(1)
    for key in ("done", "terminated", "option_done", "option_terminated"):
        after[key] = flag()
    after["done"][1, -1] = after["option_done"][2, 1] = after["option_done"][1, -1] = True
    for key in ("option_done", "option_terminated"):
        after[key][3, 2] = True
    after["done"][4, -1] = after["terminated"][4, -1] = True
    after["option_steps"] = torch.randint(1, 6, (BATCH, TIME, 1), generator=generator)
    mask = torch.rand(BATCH, TIME + 1, ACTIONS, generator=generator) < 0.6
    sample["subgoal_mask"], after["subgoal_mask"] = mask[:, :-1], mask[:, 1:]
    sample["next"] = after
    if padded:
        lengths = torch.tensor([5, 5, 5, 5, 3, 1])
        time = torch.arange(TIME).expand(BATCH, TIME).minimum(lengths[:, None] - 1)
        sample = sample[torch.arange(BATCH)[:, None], time].contiguous()
        sample["collector", "mask"] = torch.arange(TIME) < lengths[:, None]
        sample["next", "done"][4, 2] = sample["next", "terminated"][4, 2] = True
    return sample


def reference(
    loss,
    network,
    sample,
    *,
    level="flat",
    burn_in=0.5,
    exact=True,
    huber=False,
    limit=None,
    least=None,
    state=None,
    weight=None,
    errors=None,
    lookahead=0,
    **targets,
):
    """The loss by the book: one sequence, one step at a time. Returns it with the number of trained steps.

    Sequences may have a weight; ``errors`` is filled with the absolute TD errors of each.
    """
    keys = {"action": "action", "reward": "reward", "done": "done", "terminated": "terminated", "init": "is_init"}
    keys |= {"flat": {}, "sub": SUB_KEYS, "meta": META_KEYS}[level]
    target_network, gamma = target_of(loss, network), loss.gamma.item()
    after, total, count = sample["next"], 0.0, 0
    for b in range(len(sample)):
        length = int(sample["collector", "mask"][b].sum()) if ("collector", "mask") in sample else TIME
        stream = torch.cat([sample["observation"][b, :length], after["observation"][b, length - 1 : length]])[None]
        subgoal = sample["subgoal"][b : b + 1, :1].repeat(1, length + 1) if level == "sub" else None
        init = torch.cat([sample[keys["init"]][b, :length, 0], torch.tensor([False])])[None]
        first = None if state is None else [part[b : b + 1] for part in state]
        q = unroll_by_steps(network, stream, subgoal, init, first)[0]
        with torch.no_grad():
            target_q = unroll_by_steps(target_network, stream, subgoal, init, first)[0]
        done, terminated = after[keys["done"]][b, :length, 0], after[keys["terminated"]][b, :length, 0]
        masks = torch.ones(length + 1, ACTIONS, dtype=torch.bool)
        if "action_mask" in keys:
            masks = torch.cat([sample["subgoal_mask"][b, :1], after["subgoal_mask"][b, :length]])
        row = SimpleNamespace(
            reward=after[keys["reward"]][b, :, 0],
            terminated=terminated.tolist(),
            done=done.tolist(),
            cut=[t for t in range(length - 1) if done[t] and not terminated[t]],
            discount=[gamma ** (after["option_steps"][b, t].item() if "steps" in keys else 1) for t in range(length)],
            action=sample[keys["action"]][b].tolist(),
            masks=masks,
            q=q.detach(),
            target_q=target_q,
        )
        for t in range(length):
            is_exact = exact and bool(init[0, : t + 1].any())
            if (t < int((TIME - lookahead) * burn_in) and not is_exact) or t in row.cut or t >= TIME - lookahead:
                continue
            y = target(row, t, **targets)
            y = y if limit is None else min(y, torch.tensor(limit))
            y = y if least is None else max(y, torch.tensor(least))
            prediction = q[t, row.action[t]]
            distance = functional.smooth_l1_loss(prediction, y) if huber else (prediction - y) ** 2
            total = total + distance * (1.0 if weight is None else weight[b])
            if errors is not None:
                errors[b].append(abs(prediction - y).item())
            count += 1
    return total / count, count


def target(row, t, *, double=True, decay=0.0, n=1):
    """The target of step ``t`` of one sequence."""
    if row.terminated[t]:
        return row.reward[t]
    value = row.target_q[t + 1, best_of((row.q if double else row.target_q)[t + 1], row.masks[t + 1])]
    if t + 1 < len(row.done) and not row.done[t] and t + 1 not in row.cut:
        if n > 1:
            value = target(row, t + 1, double=double, n=n - 1)
        elif decay and row.action[t + 1] == best_of(row.q[t + 1], row.masks[t + 1]):
            value = (1 - decay) * value + decay * target(row, t + 1, double=double, decay=decay)
    return row.reward[t] + row.discount[t] * value


def best_of(values, mask):
    allowed = [action for action in range(ACTIONS) if mask[action] or not mask.any()]
    return max(allowed, key=lambda action: values[action])


class TestAgainstPlainLoops:
    @pytest.mark.parametrize("padded", [True, False])
    @pytest.mark.parametrize("level", ["flat", "sub", "meta"])
    @pytest.mark.parametrize(
        "settings",
        [
            {},
            {"train_exact_states": False},
            {"burn_in": 0.0},
            {"burn_in": 0.8},
            {"double": False},
            {"loss_function": "smooth_l1"},
            {"gamma": 1.0},
            {"max_target": 0.2},
            {"min_target": 0.1},
            {"min_target": -0.1, "max_target": 0.2, "n_step": 2},
            {"recurrent": False},
            {"trace_decay": 0.75},
            {"trace_decay": 0.75, "double": False, "burn_in": 0.0, "max_target": 0.2},
            {"n_step": 3},
            {"n_step": 2, "recurrent": False, "burn_in": 0.0},
            {"n_step": 3, "lookahead": 2},
            {"n_step": 2, "lookahead": 1, "recurrent": False},
            {"trace_decay": 0.75, "lookahead": 3, "burn_in": 0.7},
        ],
        ids=str,
    )
    def test_loss_and_gradients(self, level, padded, settings):
        loss, network = make_loss(level, **settings)
        sample = make_sample(padded=padded)
        result = loss(sample.clone())
        wanted, count = reference(
            loss,
            network,
            sample,
            level=level,
            burn_in=settings.get("burn_in", 0.5) if settings.get("recurrent", True) else 0.0,  # no memory, no burn-in
            exact=settings.get("train_exact_states", True),
            double=settings.get("double", True),
            huber="loss_function" in settings,
            limit=settings.get("max_target"),
            least=settings.get("min_target"),
            decay=settings.get("trace_decay", 0.0),
            n=settings.get("n_step", 1),
            lookahead=settings.get("lookahead", 0),
        )
        assert result["trained_steps"].item() == count
        torch.testing.assert_close(result["loss"], wanted)
        parameters = list(network.parameters())
        gradients = torch.autograd.grad(result["loss"], parameters, allow_unused=True)
        for gradient, want in zip(gradients, torch.autograd.grad(wanted, parameters), strict=True):
            torch.testing.assert_close(gradient, want)

    def test_without_target_network_the_main_one_values_the_next_step(self):
        torch.manual_seed(0)
        controller, sample = make_controller(), make_sample()
        loss = RecurrentDQNLoss(controller, gamma=0.9, delay_value=False)
        fresh = RecurrentDQNLoss(deepcopy(controller), gamma=0.9)  # its target network is an equal copy
        wanted, _ = reference(fresh, controller.network, sample)
        torch.testing.assert_close(loss(sample)["loss"], wanted)
        step_once(loss, sample)
        assert loss(sample)["target"] != fresh(sample)["target"]

    def test_reported_means(self):
        loss, network = make_loss()
        sample = make_sample(padded=False)
        result = loss(sample)
        network_q = unroll_by_steps(
            network, torch.cat([sample["observation"], sample["next", "observation"][:, -1:]], 1)
        )
        trained = torch.ones(BATCH, TIME, dtype=torch.bool)
        trained[[0, 2, 3, 4, 5], :2] = False
        chosen = network_q[:, :-1].gather(-1, sample["action"][..., None])[..., 0]
        assert result["q_value"].item() == pytest.approx(chosen[trained].mean().item())
        assert result["loss"].item() >= result["td_error"].item() ** 2
        assert (result["target"] - result["q_value"]).abs().item() <= result["td_error"].item() + 1e-12
        assert set(result.keys()) == set(loss.out_keys)
        assert not any(result[key].requires_grad for key in loss.out_keys if key != "loss")


class TestStoredStates:
    """Sequences that start from the LSTM state that acting had."""

    def make(self, level, **settings):
        prefix = "meta" if level == "meta" else "sub"
        state_keys = [f"{prefix}_hidden", f"{prefix}_cell"]
        loss, network = make_loss(level, state_keys=state_keys, **settings)
        sample = make_sample()
        generator = torch.Generator().manual_seed(1)
        for key in state_keys:
            sample[key] = torch.rand(BATCH, TIME, 6, generator=generator, dtype=torch.double)
        return loss, network, sample, [sample[key][:, 0].clone() for key in state_keys]

    @pytest.mark.parametrize("burn_in", [0.0, 0.5])
    @pytest.mark.parametrize("level", ["flat", "sub", "meta"])
    def test_loss_and_gradients_against_plain_loops(self, level, burn_in):
        loss, network, sample, state = self.make(level, burn_in=burn_in)
        result = loss(sample.clone())
        wanted, count = reference(loss, network, sample, level=level, burn_in=burn_in, state=state)
        assert result["trained_steps"] == count
        torch.testing.assert_close(result["loss"], wanted)
        assert (result["loss"] - reference(loss, network, sample, level=level, burn_in=burn_in)[0]).abs() > 1e-3
        parameters = list(network.parameters())
        gradients = torch.autograd.grad(result["loss"], parameters)
        for gradient, want in zip(gradients, torch.autograd.grad(wanted, parameters), strict=True):
            torch.testing.assert_close(gradient, want)

    @pytest.mark.parametrize("level", ["flat", "sub", "meta"])
    def test_only_the_first_one_is_read_and_only_where_no_episode_or_option_starts(self, level):
        loss, _, sample, _ = self.make(level, burn_in=0.0)
        wanted = loss(sample.clone())["loss"]
        for key in loss.state_keys:
            sample[key][:, 1:], sample[key][1] = NAN, NAN  # row 1 starts an episode
        torch.testing.assert_close(loss(sample)["loss"], wanted)

    def test_they_are_asked_for(self):
        loss, _, sample, _ = self.make("sub")
        assert {"sub_hidden", "sub_cell"} <= set(loss.in_keys)
        with pytest.raises(KeyError, match="sub_cell"):
            loss(sample.exclude("sub_cell"))

    def test_a_stock_lstm_starts_from_them_and_restarts_from_zero(self):
        torch.manual_seed(0)
        lstm = LSTMModule(input_size=SIZE, hidden_size=6, in_key="observation", out_key="features").double()
        head = nn.Linear(6, ACTIONS).double()
        network = TensorDictSequential(lstm, TensorDictModule(head, in_keys=["features"], out_keys=["action_value"]))
        loss = RecurrentDQNLoss(network, gamma=0.9, burn_in=0.0, state_keys=["recurrent_state_h", "recurrent_state_c"])
        sample = make_sample(padded=False)
        sample["is_init"][2, 2] = True  # a new episode in mid-sequence
        sample["next", "done"][2, 1] = sample["next", "terminated"][2, 1] = True
        for key in loss.state_keys:
            sample[key] = torch.rand(BATCH, TIME, 1, 6, dtype=torch.double)
        stream = torch.cat([sample["observation"], sample["next", "observation"][:, -1:]], 1)
        state = [sample[key][:, 0].transpose(0, 1).contiguous() for key in loss.state_keys]
        for part in state:
            part[:, 1] = 0.0  # row 1 starts an episode
        q = head(lstm.lstm(stream, tuple(state))[0])
        q[2, 2:] = head(lstm.lstm(stream[2:3, 2:])[0])[0]
        chosen = q[:, :-1].gather(-1, sample["action"][..., None])[..., 0]
        value = q[:, 1:].max(-1).values * ~sample["next", "terminated"][..., 0]
        error = (sample["next", "reward"][..., 0] + 0.9 * value - chosen) ** 2
        torch.testing.assert_close(loss(sample)["loss"], error.mean())

    def test_a_network_without_them_is_refused(self):
        with pytest.raises(ValueError, match=r"state_keys must be recurrent states .* got \['sub_hidden'\]"):
            make_loss(recurrent=False, state_keys=["sub_hidden"])


class TestPriorities:
    @pytest.mark.parametrize("padded", [True, False])
    @pytest.mark.parametrize("settings", [{}, {"loss_function": "smooth_l1"}, {"burn_in": 0.8}], ids=str)
    @pytest.mark.parametrize("level", ["flat", "sub", "meta"])
    def test_weighted_loss_and_priorities_against_plain_loops(self, level, settings, padded):
        loss, network = make_loss(level, **settings)
        sample = make_sample(padded=padded)
        sample["priority_weight"] = torch.tensor([3.0, 1.0, 0.5, 2.0, 6.0, 0.0])[:, None].expand(BATCH, TIME).double()
        errors = [[] for _ in range(BATCH)]
        others = {"burn_in": settings.get("burn_in", 0.5), "huber": "loss_function" in settings}
        weight = [0.5, 1 / 6, 1 / 12, 1 / 3, 1.0, 0.0]  # relative to the largest
        wanted, count = reference(loss, network, sample, level=level, weight=weight, errors=errors, **others)
        result = loss(sample.clone())
        torch.testing.assert_close(result["loss"], wanted)
        assert result["trained_steps"] == count and result["loss"].requires_grad
        priorities = [0.9 * max(found) + 0.1 * sum(found) / len(found) if found else 0.0 for found in errors]
        assert result["priority"].tolist() == pytest.approx(priorities) and not result["priority"].requires_grad

    def test_what_is_reported_has_no_weights(self):
        loss, _ = make_loss()
        sample = make_sample()
        plain = loss(sample)
        sample["priority_weight"] = torch.rand(BATCH, 1).expand(BATCH, TIME)
        weighted = loss(sample)
        assert weighted["loss"] != plain["loss"]
        for key in ("td_error", "q_value", "target", "trained_steps"):
            assert weighted[key] == plain[key]

    def test_equal_weights_change_nothing(self):
        loss, _ = make_loss()
        sample = make_sample()
        plain = loss(sample)["loss"]
        sample["priority_weight"] = torch.full((BATCH, TIME), 0.1)
        assert loss(sample)["loss"] == plain


class TestLeaks:
    """Nothing in one sequence changes what is learned from another."""

    @pytest.mark.parametrize("level", ["flat", "sub", "meta"])
    def test_the_loss_of_a_batch_is_that_of_its_rows(self, level):
        loss, _ = make_loss(level)
        sample = make_sample()
        rows = [loss(sample[b : b + 1]) for b in range(BATCH)]
        together = loss(sample)
        summed = sum(row["loss"] * row["trained_steps"] for row in rows) / sum(row["trained_steps"] for row in rows)
        torch.testing.assert_close(together["loss"], summed)

    @pytest.mark.parametrize("level", ["flat", "sub", "meta"])
    def test_a_changed_row_changes_no_other_rows_values(self, level):
        _, network = make_loss(level)
        controller = {"flat": flat, "sub": SubController, "meta": MetaController}[level](network)
        sample = make_sample()
        changed = sample.clone()
        changed["observation"][0] += 1.0
        with set_recurrent_mode(True):
            key = controller.action_value_key
            before, after = controller(sample.clone())[key], controller(changed)[key]
        assert (before[0] != after[0]).all()
        assert (before[1:] == after[1:]).all()

    def test_an_option_learns_nothing_from_the_one_before_it(self):
        loss, _ = make_loss("sub", train_exact_states=True, burn_in=0.8)
        sample = make_sample(padded=False)[2:3]  # options: steps 0 and 1, then 2 to 4
        changed = sample.clone()
        changed["observation"][:, :2] += 1.0
        assert loss(sample)["trained_steps"] == 3
        assert loss(sample)["loss"] == loss(changed)["loss"]
        changed["observation"][:, 2] += 1.0
        assert loss(sample)["loss"] != loss(changed)["loss"]

    def test_an_option_that_ends_in_mid_sequence_has_the_exact_target(self):
        """A terminated option needs nothing from the next one, a cut one is left out."""
        loss, _ = make_loss("sub", burn_in=0.0)
        sample = make_sample(padded=False)
        cut, terminated = sample[2:3], sample[3:4]
        assert loss(cut)["trained_steps"] == TIME - 1
        assert loss(terminated)["trained_steps"] == TIME
        first_option = terminated[:, :3].clone()
        changed = first_option.clone()
        changed["next", "observation"][:, -1] += 1.0
        torch.testing.assert_close(loss(first_option)["loss"], loss(changed)["loss"])


def flat(network):
    return SubController(network, subgoal_key=None, init_key="is_init")


class TestShortSequences:
    @pytest.mark.parametrize("length", [1, 2, 3])
    @pytest.mark.parametrize("level", ["sub", "meta"])
    def test_options_and_episodes_far_shorter_than_the_slice_are_trained(self, level, length):
        loss, _ = make_loss(level)
        short = make_sample(padded=False)[1:2, :length]
        padded = short[:, torch.arange(8).clamp(max=length - 1)].contiguous()
        padded["collector", "mask"] = (torch.arange(8) < length)[None]
        result = loss(padded)
        assert result["trained_steps"] == length and result["loss"] > 0
        torch.testing.assert_close(result["loss"], loss(short)["loss"])

    def test_a_batch_in_which_nothing_is_trained_costs_nothing(self):
        loss, network = make_loss(burn_in=0.5, train_exact_states=False)
        sample = make_sample()
        sample["collector", "mask"] = torch.zeros(BATCH, TIME, dtype=torch.bool)
        result = loss(sample)
        assert result["loss"].item() == 0 and result["trained_steps"] == 0
        result["loss"].backward()
        assert all(p.grad is None or not p.grad.any() for p in network.parameters())


class TestNaN:
    @pytest.mark.parametrize("settings", [{}, {"trace_decay": 0.5}, {"n_step": 2}], ids=str)
    @pytest.mark.parametrize("level", ["flat", "sub", "meta"])
    def test_nan_in_the_padding_reaches_neither_loss_nor_gradient(self, level, settings):
        loss, network = make_loss(level, **settings)
        sample = make_sample()
        clean = loss(sample)["loss"]
        wanted = torch.autograd.grad(clean, list(network.parameters()))
        padding = ~sample["collector", "mask"]
        assert padding.any()
        for part in (sample, sample["next"]):
            for value in part.values():
                if isinstance(value, torch.Tensor) and value.is_floating_point():
                    value[padding] = NAN
        dirty = loss(sample)["loss"]
        torch.testing.assert_close(dirty, clean)
        for gradient, want in zip(torch.autograd.grad(dirty, list(network.parameters())), wanted, strict=True):
            torch.testing.assert_close(gradient, want)

    def test_padding_need_not_repeat_the_last_step(self):
        loss, _ = make_loss()
        sample = make_sample()
        clean, padding = loss(sample)["loss"], ~sample["collector", "mask"]
        for value in (sample["observation"], sample["next", "observation"], sample["next", "reward"]):
            value[padding] = 5.0
        sample["is_init"][padding] = sample["next", "done"][padding] = True
        torch.testing.assert_close(loss(sample)["loss"], clean)


class TestTargetNetwork:
    def test_it_starts_as_a_copy(self):
        loss = RecurrentDQNLoss(make_controller())
        assert parameter_distance(loss.value_network_params, loss.target_value_network_params) == 0

    def test_no_gradient_reaches_it_and_no_optimiser_step_moves_it(self):
        loss, network = make_loss()
        before = loss.target_value_network_params.clone()
        optimiser = torch.optim.SGD(loss.parameters(), lr=0.1)
        values = [p.detach().clone() for p in network.parameters()]
        loss(make_sample())["loss"].backward()
        optimiser.step()
        assert all(p.grad is None for p in loss.target_value_network_params.values(True, True))
        assert not any(p.requires_grad for p in loss.target_value_network_params.values(True, True))
        assert parameter_distance(before, loss.target_value_network_params) == 0
        assert all((p != old).any() for p, old in zip(network.parameters(), values, strict=True))

    def test_the_targets_come_from_it(self):
        loss, network = make_loss()
        sample = make_sample()
        before = loss(sample)
        with torch.no_grad():
            for parameter in target_parameters(loss, network):
                parameter.mul_(2.0)
        after = loss(sample)
        assert before["target"] != after["target"] and before["q_value"] == after["q_value"]

    def test_a_soft_update_moves_it_at_the_rate_tau(self):
        torch.manual_seed(0)
        controller = make_controller()
        loss = RecurrentDQNLoss(controller)
        updater, network = SoftUpdate(loss, tau=0.1), controller.network
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.add_(1.0)
        for updates in (1, 2, 3):
            updater.step()
            for main, target in zip(network.parameters(), target_parameters(loss, network), strict=True):
                torch.testing.assert_close(main - target, torch.full_like(main, 0.9**updates))
        sample = make_sample()
        torch.testing.assert_close(loss(sample)["loss"], reference(loss, network, sample)[0])

    def test_it_is_not_among_the_parameters_to_train(self):
        loss, network = make_loss()
        trained = {id(p) for p in loss.parameters() if p.requires_grad}
        assert trained == {id(p) for p in network.parameters()}


def step_once(loss, sample):
    optimiser = torch.optim.SGD([p for p in loss.parameters() if p.requires_grad], lr=0.1)
    loss(sample)["loss"].backward()
    optimiser.step()


class TestOneNetworkForActingAndLearning:
    """The acting network and the loss share their parameters, whatever is done to the loss."""

    def check(self, loss, network):
        """An update through the loss changes what the acting network computes, and the loss reads what it has."""
        sample = make_sample()
        before = network.unroll(sample["observation"])
        step_once(loss, sample)
        assert (network.unroll(sample["observation"]) != before).any()
        torch.testing.assert_close(loss(sample)["loss"], reference(loss, network, sample)[0])

    def test_as_built(self):
        self.check(*make_loss())

    def test_after_to(self):
        loss, network = make_loss()
        self.check(loss.to("cpu"), network)

    def test_after_a_change_of_dtype_and_back(self):
        loss, network = make_loss()
        self.check(loss.to(torch.float32).to(torch.float64), network)

    def test_after_a_round_trip_through_the_state_dict(self):
        source, source_network = make_loss()
        sample = make_sample()
        step_once(source, sample)
        loss, network = make_loss()
        loss.load_state_dict(deepcopy(source.state_dict()))
        assert parameter_distance(source.value_network_params, loss.value_network_params) == 0
        assert parameter_distance(source.target_value_network_params, loss.target_value_network_params) == 0
        torch.testing.assert_close(loss(sample)["loss"], source(sample)["loss"])
        torch.testing.assert_close(network.unroll(sample["observation"]), source_network.unroll(sample["observation"]))
        self.check(loss, network)

    def test_after_the_acting_network_loads_weights(self):
        loss, network = make_loss()
        other = make_controller().network
        network.load_state_dict(other.state_dict())
        self.check(loss, network)


class TestStockModules:
    """Any TorchRL module with the right keys can be the value network."""

    def make(self):
        torch.manual_seed(0)
        lstm = LSTMModule(input_size=SIZE, hidden_size=6, in_key="observation", out_key="features").double()
        head = nn.Sequential(nn.Linear(6, 8), nn.ReLU(), nn.Linear(8, ACTIONS)).double()
        network = TensorDictSequential(lstm, TensorDictModule(head, in_keys=["features"], out_keys=["action_value"]))
        return network, lambda x: head(lstm.lstm(x)[0])

    def test_an_lstm_and_a_multilayer_perceptron(self):
        network, values = self.make()
        loss = RecurrentDQNLoss(network, gamma=0.9, train_exact_states=False)
        sample = make_sample(padded=False)
        q = values(torch.cat([sample["observation"], sample["next", "observation"][:, -1:]], 1))
        chosen = q[:, :-1].gather(-1, sample["action"][..., None])[..., 0]
        value = q[:, 1:].max(-1).values.detach() * ~sample["next", "terminated"][..., 0]
        error = (sample["next", "reward"][..., 0] + 0.9 * value - chosen) ** 2
        torch.testing.assert_close(loss(sample)["loss"], error[:, 2:].mean())

    def test_its_state_restarts_where_an_episode_starts(self):
        network, _ = self.make()
        loss = RecurrentDQNLoss(network, gamma=0.9, burn_in=0.8)
        sample = make_sample(padded=False)[:1]
        sample["is_init"][0, 2] = True
        changed = sample.clone()
        changed["observation"][:, :2] += 1.0
        assert loss(sample)["trained_steps"] == 3
        torch.testing.assert_close(loss(sample)["loss"], loss(changed)["loss"])

    def test_recurrent_states_are_not_read_from_the_sample(self):
        network, _ = self.make()
        loss = RecurrentDQNLoss(network)
        states = [key for key in network.in_keys if "recurrent" in str(key) or "hidden" in str(key)]
        assert states and not set(states) & set(loss.in_keys)

    def test_a_feed_forward_network(self):
        network = TensorDictModule(nn.Linear(SIZE, ACTIONS).double(), ["observation"], ["action_value"])
        result = RecurrentDQNLoss(network)(make_sample())
        assert result["loss"] > 0


class TestKeys:
    def test_every_key_can_be_renamed_and_nested(self):
        loss, network = make_loss("meta")
        names = {
            "action": "subgoal", "reward": "option_return", "steps": "option_steps", "done": "done",
            "terminated": "terminated", "init": "is_init", "action_mask": "subgoal_mask",
        }  # fmt: skip
        sample = make_sample()
        wanted = loss(sample)["loss"]
        renamed = sample.clone()
        for name in names.values():
            for part in (renamed, renamed["next"]):
                if name in part:
                    part["other", name] = part.pop(name)
        renamed["my_mask"] = renamed.pop(("collector", "mask"))
        controller = MetaController(network, mask_key=("other", "subgoal_mask"), action_value_key=("other", "q"))
        other = RecurrentDQNLoss(controller, gamma=0.9)
        other.target_value_network_params.data.copy_(loss.target_value_network_params.data)
        other.set_keys(
            **{kind: ("other", name) for kind, name in names.items()}, mask="my_mask", action_value=("other", "q")
        )
        torch.testing.assert_close(other(renamed)["loss"], wanted)

    def test_in_keys_are_what_it_reads_and_all_it_reads(self):
        for level in ("flat", "sub", "meta"):
            loss, _ = make_loss(level)
            sample = make_sample()
            wanted = loss(sample)["loss"]
            kept = sample.select(*loss.in_keys, ("collector", "mask"))
            assert loss(kept)["loss"] == wanted
            for key in loss.in_keys:
                with pytest.raises(KeyError, match=str(key[-1] if isinstance(key, tuple) else key)):
                    loss(kept.exclude(key))

    def test_the_sample_is_left_as_it_was(self):
        loss, _ = make_loss()
        sample = make_sample()
        before = sample.clone()
        loss(sample)
        assert (sample == before).all() and set(sample.keys(True)) == set(before.keys(True))

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"gamma": 1.1}, r"gamma must lie in \[0, 1\], got 1.1; "),
            ({"lookahead": -1}, r"lookahead must be >= 0 steps, got -1; "),
            ({"burn_in": 1.0}, r"burn_in must lie in \[0, 1\), got 1.0; "),
            ({"loss_function": "l1"}, "loss_function must be 'l2' or 'smooth_l1', got 'l1'; "),
            ({"trace_decay": 1.1}, r"trace_decay must lie in \[0, 1\], got 1.1; "),
            ({"n_step": 0}, "n_step must be >= 1, got 0; "),
            ({"n_step": 2, "trace_decay": 0.5}, "n_step must be 1 where trace_decay > 0, got n_step=2 and .*0.5; "),
        ],
    )
    def test_wrong_values(self, settings, message):
        with pytest.raises(ValueError, match=message):
            RecurrentDQNLoss(make_controller(), **settings)


class TestPrediction:
    """A second task for the memory of a network that has a predictor."""

    def sample(self, name="v2", **options):
        torch.manual_seed(0)
        env = small_env(8, max_steps=6)
        settings = tiny_settings(slice_len=5, batch_size=64, burn_in=0.0)
        algorithm = build(name, env, settings=settings, prediction_steps=3, prediction_weight=0.5, **options)
        learner = next(iter(algorithm.learners.values()))
        for batch in collect(algorithm, env, 20, batches=2):
            learner.store(batch)
        return learner.loss, learner.sample(), learner.network.network

    @pytest.mark.parametrize("name", ["v2", "v1", "drqn"])
    def test_what_is_expected_within_the_episode_enters_the_loss(self, name):
        loss, sample, network = self.sample(name)
        rows, steps = sample.shape
        valid, done = sample["collector", "mask"], sample["next", "done"].squeeze(-1)
        seen, padded = set(), 0
        for seed in range(8):
            torch.manual_seed(seed)
            ahead = int(torch.randint(1, 4, ()))
            torch.manual_seed(seed)
            result = loss(sample)
            with torch.no_grad():
                inputs = loss._take_apart(sample).inputs
                memory = loss._action_values(inputs)[2]
                errors = network.predictor(memory, sample["action"][:, :-1], inputs["observation"], steps=ahead)
            kept = [
                errors[b, t].item()
                for b in range(rows)
                for t in range(steps - ahead)
                if valid[b, t : t + ahead + 1].all() and not done[b, t : t + ahead].any()
            ]
            padded += errors.numel() - len(kept)
            assert result["prediction_loss"].item() == pytest.approx(sum(kept) / len(kept), rel=1e-4)
            assert set(result.keys()) == set(loss.out_keys)
            seen.add(ahead)
        assert seen == {1, 2, 3} and padded > 0

    def test_it_trains_the_memory_and_the_predictor(self):
        loss, sample, network = self.sample()
        with torch.no_grad():
            network.head.streams.weight.zero_()  # no way to the memory through the values
        loss(sample)["loss"].backward()
        for part in (network.memory, network.predictor.decoder):
            assert all((p.grad != 0).any() for p in part.parameters())

    def test_the_weight_is_that_of_its_error(self):
        loss, sample, _ = self.sample()
        total = []
        for weight in (0.0, 1.0):
            torch.manual_seed(0)
            loss.prediction_weight = weight
            result = loss(sample)
            total.append(result["loss"].item())
        assert total[1] - total[0] == pytest.approx(result["prediction_loss"].item(), rel=1e-4)

    def test_a_network_without_memory_has_none(self):
        with pytest.raises(ValueError, match="predictor must be None with recurrent=False"):
            build("v1", small_env(4), prediction_steps=1, recurrent=False)


def _init_of(loss, sample):
    return sample[loss.tensor_keys.init].squeeze(-1)


@pytest.mark.parametrize(
    ("settings", "wanted"),
    [
        # Actions 0, 0; Q-values (1, 5), (2, 9), (3, 4); the second step has action 0 only; discount 1/2.
        ({}, [0.5 * 2, 0.5 * 4]),
        ({"trace_decay": 0.5}, [0.5 * (0.5 * 2 + 0.5 * 2), 2]),  # action 0 is greedy where nothing else is left
        ({"n_step": 2, "lookahead": 2}, [0.25 * 4]),
    ],
    ids=str,
)
def test_targets_count_on_no_action_that_cannot_be_chosen(settings, wanted):
    network = TensorDictModule(nn.Linear(2, 2, bias=False), ["observation"], ["action_value"])
    nn.init.eye_(network.module.weight)
    loss = RecurrentDQNLoss(network, **({"gamma": 0.5, "lookahead": 1} | settings))
    loss.set_keys(action_mask="action_mask")
    sample = TensorDict(batch_size=[1, 3])
    sample["observation"] = torch.tensor([[[1.0, 5.0], [2.0, 9.0], [3.0, 4.0]]])
    sample["action_mask"] = torch.tensor([[[True, True], [True, False], [True, True]]])
    sample["action"], sample["next", "reward"] = torch.zeros(1, 3, dtype=torch.int64), torch.zeros(1, 3, 1)
    for key in ("is_init", ("next", "done"), ("next", "terminated")):
        sample[key] = torch.zeros(1, 3, 1, dtype=torch.bool)
    assert loss(sample)["target"].item() == pytest.approx(sum(wanted) / len(wanted))


@pytest.mark.parametrize(("level", "expected"), [("flat", {}), ("sub", SUB_KEYS), ("meta", META_KEYS)])
def test_a_loss_finds_what_its_controller_learns_from(level, expected):
    """Nobody has to know that a sub level is paid otherwise, and has other ends, than the task has."""
    found = RecurrentDQNLoss(make_controller(level)).tensor_keys
    for name, key in expected.items():
        assert getattr(found, name) == key, name
    others = RecurrentDQNLoss.default_keys()
    for name in set(SUB_KEYS | META_KEYS) - set(expected):
        assert getattr(found, name) == getattr(others, name), name


def test_choices_that_are_masked_in_acting_are_masked_in_targets():
    network = QNetwork(FullyConnectedFeatures(SIZE, (7,)), num_actions=ACTIONS, hidden_size=6)
    controller = SubController(network, subgoal_key=None, init_key="is_init", mask_key="allowed")
    assert RecurrentDQNLoss(controller).tensor_keys.action_mask == "allowed"


def test_a_loss_can_be_made_of_doubles():
    loss = RecurrentDQNLoss(make_controller().float()).double()
    assert {each.dtype for each in loss.parameters()} == {torch.float64}


@pytest.mark.parametrize("level", ["flat", "sub", "meta"])
def test_a_copy_of_a_loss_is_whole(level):
    """What it registers is what its networks hold: all layers, of both networks."""
    loss, _ = make_loss(level)
    copy = deepcopy(loss)
    before = {key: value.clone() for key, value in copy.target_value_network_params.flatten_keys(".").items()}
    with torch.no_grad():
        for parameter in copy.parameters():
            parameter.add_(1.0)
    SoftUpdate(copy, tau=0.5).step()
    network, target = copy._networks
    for key, value in copy.target_value_network_params.flatten_keys(".").items():
        moved = key in dict(network.named_parameters())
        assert (value != before[key]).any() == moved and attrgetter(key)(target) is value, key
    for key, value in network.named_parameters():
        assert copy.value_network_params.flatten_keys(".")[key] is value, key
    copy.load_state_dict(loss.state_dict())
    for key, value in before.items():
        assert torch.equal(attrgetter(key)(target), value), key
