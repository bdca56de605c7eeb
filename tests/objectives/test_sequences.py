"""Sequences that hold each input once teach what those with every input twice do."""

import pytest
import torch
from tensordict import TensorDict
from test_recurrent_dqn import ACTIONS, BATCH, NAN, TIME, make_loss, make_sample

from hdrqn_torchrl.objectives.sequences import take_apart

INPUTS = ("observation", "subgoal", "subgoal_mask")


def lengths_of(sample):
    return sample["collector", "mask"].sum(1) if ("collector", "mask") in sample else torch.full((BATCH,), TIME)


def once(sample):
    """The same sequences with one step more in place of the inputs under ``"next"``."""
    rows, lengths = torch.arange(BATCH), lengths_of(sample)
    longer = torch.cat([sample, sample[:, -1:].clone()], 1)
    for key in INPUTS:
        longer[key][rows, lengths] = sample["next", key][rows, lengths - 1]
    for key in ("is_init", "option_init"):
        longer[key][rows, lengths] = False
    longer["next"] = longer["next"].exclude(*INPUTS)
    longer["collector", "mask"] = torch.arange(TIME + 1) <= lengths[:, None]
    return longer


def uncut(sample):
    """Without options and episodes that are cut at the end of a sequence: only ``"next"`` has what they led to."""
    rows, last = torch.arange(BATCH), lengths_of(sample) - 1
    for done, terminated in (("done", "terminated"), ("option_done", "option_terminated")):
        sample["next", done][rows, last] &= sample["next", terminated][rows, last]
    return sample


SETTINGS = [{}, {"burn_in": 0.0}, {"trace_decay": 0.75}, {"n_step": 3}, {"recurrent": False}, {"double": False}]


@pytest.mark.parametrize("padded", [True, False], ids=["padded", "whole"])
@pytest.mark.parametrize("settings", SETTINGS, ids=str)
@pytest.mark.parametrize("level", ["flat", "sub", "meta"])
def test_both_forms_have_the_same_loss_and_gradients(level, settings, padded):
    sample = uncut(make_sample(padded=padded))
    twice, network = make_loss(level, **settings)
    single, other = make_loss(level, lookahead=1, **settings)
    expected, found = twice(sample), single(once(sample))
    assert found["trained_steps"] == expected["trained_steps"] > 0
    for key in ("loss", "td_error", "q_value", "target", "priority"):
        torch.testing.assert_close(found[key], expected[key])
    gradients = (torch.autograd.grad(r["loss"], n.parameters()) for r, n in ((found, other), (expected, network)))
    for gradient, wanted in zip(*gradients, strict=True):
        torch.testing.assert_close(gradient, wanted)


@pytest.mark.parametrize("level", ["flat", "sub", "meta"])
def test_stored_states_begin_a_sequence_of_either_form(level):
    prefix = "meta" if level == "meta" else "sub"
    state_keys = [f"{prefix}_hidden", f"{prefix}_cell"]
    sample = uncut(make_sample())
    for key in state_keys:
        sample[key] = torch.rand(BATCH, TIME, 6, dtype=torch.double)
    twice, _ = make_loss(level, state_keys=state_keys, burn_in=0.0)
    single, _ = make_loss(level, state_keys=state_keys, burn_in=0.0, lookahead=1)
    torch.testing.assert_close(single(once(sample))["loss"], twice(sample)["loss"])


@pytest.mark.parametrize("level", ["flat", "sub", "meta"])
def test_nan_in_the_padding_reaches_no_gradient(level):
    loss, network = make_loss(level, lookahead=1, trace_decay=0.5)
    sample = once(make_sample())
    wanted = torch.autograd.grad(loss(sample)["loss"], network.parameters())
    padding = ~sample["collector", "mask"]
    for part in (sample, sample["next"]):
        for value in part.values():
            if isinstance(value, torch.Tensor) and value.is_floating_point():
                value[padding] = NAN
    for gradient, want in zip(torch.autograd.grad(loss(sample)["loss"], network.parameters()), wanted, strict=True):
        torch.testing.assert_close(gradient, want)


def flags(*steps, time=4):
    return torch.tensor([[[step in steps] for step in range(time)]])


@pytest.mark.parametrize(
    ("done", "terminated", "init", "real", "trained"),
    [
        ((), (), (), 4, [0, 1, 2]),  # the last one only shows what step 2 led to
        ((1,), (1,), (2,), 4, [0, 1, 2]),  # an option that terminated needs nothing from what follows
        ((1,), (), (2,), 4, [0, 2]),  # one that was cut: the next step pursues something else
        ((2,), (), (3,), 4, [0, 1]),  # the same at the last step that could be trained
        ((2,), (2,), (3,), 4, [0, 1, 2]),
        ((1,), (), (), 2, [0]),  # a truncated episode, then padding
        ((1,), (1,), (), 2, [0, 1]),
        ((), (), (), 2, [0]),  # the newest step of the memory: what it led to is not there yet
        ((), (), (2,), 4, [0, 2]),  # a restart that no end announces
        ((3,), (3,), (), 4, [0, 1, 2]),  # the last one is never trained
    ],
)
def test_steps_are_trained_whose_target_is_in_the_sequence(done, terminated, init, real, trained):
    """By hand: Q(s, 0) of state s is 10 s, the reward 1, the discount 0.5."""
    loss, _ = make_loss("flat", lookahead=1, burn_in=0.0, recurrent=False, gamma=0.5)
    table = 10.0 * torch.arange(4.0, dtype=torch.double)
    sample = TensorDict({"action": torch.zeros(1, 4, dtype=torch.int64), "is_init": flags(*init)}, [1, 4])
    sample["observation"] = torch.zeros(1, 4, 3, dtype=torch.double)
    sample["next"] = {"reward": torch.ones(1, 4, 1), "done": flags(*done), "terminated": flags(*terminated)}
    sample["collector", "mask"] = torch.arange(4)[None] < real
    values = table.view(1, 4, 1).expand(1, 4, ACTIONS).clone().requires_grad_()
    loss._action_values = lambda inputs: (values, values.detach(), None)
    result = loss(sample)
    assert result["trained_steps"] == len(trained)
    (gradient,) = torch.autograd.grad(result["loss"], values)
    wanted = [
        2 * (table[t] - (1.0 + (0.0 if t in terminated else 0.5 * table[t + 1]))) / len(trained) if t in trained else 0
        for t in range(4)
    ]
    assert gradient[0, :, 0].tolist() == pytest.approx([float(each) for each in wanted])


def test_the_input_that_follows_need_not_be_asked_for():
    single, _ = make_loss("meta", lookahead=1)
    nexts = {key[1] for key in single.in_keys if isinstance(key, tuple) and key[0] == "next"}
    assert nexts == {"option_return", "option_steps", "done", "terminated"}
    sample = once(make_sample())
    kept = sample.select(*single.in_keys, ("collector", "mask"))
    assert single(kept)["loss"] == single(sample)["loss"]


def test_a_longer_lookahead_reads_either_form():
    sample = uncut(make_sample(padded=False))
    twice, _ = make_loss("flat", lookahead=2, n_step=3)
    single, _ = make_loss("flat", lookahead=3, n_step=3)
    torch.testing.assert_close(single(once(sample))["loss"], twice(sample)["loss"])


def test_the_parts_of_a_sequence():
    sample = once(make_sample())
    parts = take_apart(
        sample,
        sample["collector", "mask"],
        read_keys=["observation"],
        state_keys=[],
        init_key="is_init",
        done_key="done",
        lookahead=2,
        stored_once=True,
    )
    assert parts.inputs.shape == (BATCH, TIME + 1) and parts.steps.shape == (BATCH, TIME) and parts.lookahead == 1
    assert torch.equal(parts.seen[:, :-1], parts.valid)
