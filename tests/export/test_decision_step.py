"""One decision as a function of tensors is the policy's decision in its environment."""

import pytest
import torch
from exported_agents import KINDS, make_agent
from torchrl.envs import Compose
from torchrl.envs.transforms import DoubleToFloat

from hdrqn_torchrl.export import DecisionStep, agreement_with
from hdrqn_torchrl.keys import IS_INIT

FLAT = ("dqn", "drqn", "v3 with one level", "codes")


def noting(step, key):
    """The step, and how often an entry was set after the first decision of an episode."""
    seen = []

    def decide(inputs):
        outputs = step(inputs)
        if key in outputs:
            seen.append(int((outputs[key] & ~inputs[IS_INIT]).sum()))
        return outputs

    return decide, seen


@pytest.mark.parametrize("kind", KINDS)
def test_the_decision_is_the_policys_in_50_whole_episodes(kind):
    algorithm, env = make_agent(kind)
    step = DecisionStep(algorithm, env)
    decide, ended = noting(step, "option_init")
    found = agreement_with(decide, step, env)
    assert (found.episodes, found.other_actions) == (50, 0) and found.largest_difference <= 1e-5
    assert found.decisions > 200 and (kind in FLAT) == (not ended)
    assert kind in FLAT or sum(ended) > 2, "options end in mid-episode"


@pytest.mark.parametrize("lost", ["sub_hidden", "active_subgoal", "subgoal_mask", "meta_cell", "option_steps"])
def test_every_part_of_the_state_is_needed(lost):
    algorithm, env = make_agent("v2 with short options")
    step = DecisionStep(algorithm, env)

    def forgetful(inputs):
        return step(inputs | {lost: torch.zeros_like(inputs[lost])})

    assert agreement_with(forgetful, step, env).largest_difference > 1e-3


@pytest.mark.parametrize("kind", ["v1 with three levels", "v3", "v3 that finds its subgoals"])
def test_the_state_may_hold_anything_where_an_episode_begins(kind):
    algorithm, env = make_agent(kind, 2)
    step = DecisionStep(algorithm, env)
    clean = step.example()
    dirty = {part.name: torch.ones_like(clean[part.name]) for part in step.carried}
    expected, found = step(clean), step(clean | dirty)
    assert all(torch.equal(value, found[name]) for name, value in expected.items())


def test_a_decision_needs_nothing_of_the_agent_in_the_environment():
    """Played in the bare environment, episode for episode the same."""
    algorithm, env = make_agent("v3 with three levels", 8)
    env.set_seed(3)
    expected = env.rollout(25, algorithm.policy, break_when_any_done=False)
    step = DecisionStep(algorithm, env)
    inputs, bare = step.example(), env.base_env
    bare.set_seed(3)
    inputs = {name: value[:1].expand(8, *value.shape[1:]) for name, value in inputs.items()}
    tensordict = bare.reset()
    for time in range(25):
        inputs |= {key: tensordict[key] for key in step.observed if key in tensordict}
        outputs = step(inputs)
        assert torch.equal(outputs["action"], expected["action"][:, time])
        after, tensordict = bare.step_and_maybe_reset(tensordict.set("action", outputs["action"]))
        inputs |= {part.name: outputs["next_" + part.name] for part in step.carried}
        inputs[IS_INIT] = after["next", "done"]
    assert expected["next", "done"].any()


def test_an_agent_with_transforms_that_are_not_known_is_refused(monkeypatch):
    algorithm, env = make_agent("drqn", 2)
    extended = lambda: Compose(*make_transforms().transforms, DoubleToFloat())  # noqa: E731
    make_transforms = algorithm.make_transforms
    object.__setattr__(algorithm, "make_transforms", extended)
    with pytest.raises(ValueError, match=r"transforms must be those of this project .* got DoubleToFloat as well; put"):
        DecisionStep(algorithm, env)
