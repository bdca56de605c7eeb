"""Actions that the environment's ``action_mask`` excludes are never chosen: the corridor fails if one is."""

import pytest
import torch
from helpers import ALGORITHMS, build, collect
from torchrl.data import Binary
from torchrl.envs import ExplorationType, set_exploration_type
from user_envs import Corridor

from hdrqn_torchrl.modules import EpsilonGreedy, RepeatingEpsilonGreedy, SuccessEpsilonGreedy, writing_values

EVERY = [*ALGORITHMS, "v3", "hindsight"]
FLAT = ("dqn", "drqn")


def corridor(**settings):
    return Corridor(8, length=12, masked=True, **settings)


def agent(name, env, exploration=None):
    options = {}
    if exploration is not None:
        options = {"exploration" if name in FLAT else "sub_exploration": exploration}
    if name == "hindsight":
        return build("v2", env, sub_hindsight=True, meta_hindsight=True, **options)
    return build(name, env, **options)


def train(algorithm, env, batches=4):
    collected = collect(algorithm, env, 12, batches)
    for batch in collected:
        algorithm.observe(batch)
        for learner in algorithm.learners.values():
            for _ in range(learner.updates_due()):
                assert learner.learn()["loss"].isfinite()
    return collected


@pytest.mark.parametrize("name", EVERY)
def test_masked_actions_are_chosen_neither_in_training_nor_in_evaluation(name):
    torch.manual_seed(0)
    env = corridor()
    algorithm = agent(name, env)
    batches = train(algorithm, env)
    assert all(learner.updates for learner in algorithm.learners.values())
    assert not torch.cat(batches, 1)["action_mask"].all()  # the ends were reached
    for kind in (ExplorationType.DETERMINISTIC, ExplorationType.RANDOM):
        with set_exploration_type(kind):
            algorithm.transform(corridor()).rollout(40, algorithm.policy, break_when_any_done=False)


@pytest.mark.parametrize("name", EVERY)
def test_greedy_choices_are_the_best_among_those_that_can_be_chosen(name):
    """The network is made to want to go left always, into the wall if it could."""
    torch.manual_seed(0)
    algorithm = agent(name, corridor())
    with torch.no_grad():
        network = algorithm.policy.network if name == "v3" else algorithm.policy
        network = getattr(network, "sub_controller", network)
        head = network.sub_head[-1] if name == "v3" else network.network.head.streams
        head.bias.view(-1, 3)[:, 1] += 100.0
    with set_exploration_type(ExplorationType.DETERMINISTIC), writing_values(algorithm.policy):
        steps = algorithm.transform(corridor()).rollout(6, algorithm.policy)
    assert steps["action"].tolist() == [[0, 0, 1, 0, 1, 0]] * 8
    assert steps["action_value"].argmax(-1).unique().tolist() == [0]


@pytest.mark.parametrize(
    "exploration",
    [
        EpsilonGreedy(1.0, 1.0),
        RepeatingEpsilonGreedy(1.0, 1.0, exponent=0.1),
        SuccessEpsilonGreedy(1.0, 1.0, exponent=0.1, max_repeats=9),
    ],
    ids=lambda each: type(each).__name__,
)
@pytest.mark.parametrize("name", ["drqn", "v2", "v3"])
def test_no_exploration_chooses_a_masked_action(name, exploration):
    if name == "drqn" and exploration.needs_subgoals:
        return
    torch.manual_seed(0)
    env = corridor()
    algorithm = agent(name, env, exploration)
    steps = torch.cat(collect(algorithm, env, 60, 1), 1)
    place, action = steps["observation"].flatten(1), steps["action"]
    assert (action[place == 0] == 1).all() and (action[place == 4] == 0).all()
    assert (place == 0).sum() > 20 and (place == 4).sum() > 20


@pytest.mark.parametrize("name", EVERY)
def test_replayed_sequences_hold_the_mask_and_the_task_has_it_at_level_0(name):
    env = corridor()
    algorithm = agent(name, env)
    train(algorithm, env)
    sample = next(iter(algorithm.learners.values())).sample()
    assert sample["action_mask"].dtype == torch.bool and sample["action_mask"].shape[-1] == 2
    assert [view.name for view in algorithm.levels if view.mask_key == "action_mask"] == [algorithm.levels[0].name]


@pytest.mark.parametrize("name", EVERY)
def test_without_the_entry_nothing_is_stored_or_read(name):
    env = Corridor(8, length=12)
    algorithm = agent(name, env)
    train(algorithm, env)
    sample = next(iter(algorithm.learners.values())).sample()
    assert "action_mask" not in sample.keys() and "action_mask" not in algorithm.policy.in_keys  # noqa: SIM118


@pytest.mark.parametrize("name", ["dqn", "v3"])
def test_a_mask_of_another_shape_or_kind_is_refused(name):
    for spec in (Binary(shape=(8, 3), dtype=torch.bool), Binary(shape=(8, 2), dtype=torch.int8)):
        with pytest.raises(ValueError, match=r"'action_mask' must be \[8, 2\] bool, got"):
            build(name, corridor(odd={"action_mask": spec}))


@pytest.mark.parametrize("name", EVERY)
def test_values_of_masked_actions_never_reach_a_target(name):
    """Targets are the same whether what can't be chosen is worth a thousand or nothing."""
    torch.manual_seed(0)
    env = corridor()
    algorithm = agent(name, env)
    train(algorithm, env, 2)
    learner = next(iter(algorithm.learners.values()))
    sample = learner.sample()
    sample["action_mask"] = torch.tensor([True, False]).expand_as(sample["action_mask"]).clone()
    sample["action"].zero_()
    wanted = []
    for bias in (0.0, 1_000.0):
        for controller in learner.loss._networks:
            network = controller.network
            _raise_second((network.sub_head[-1] if name == "v3" else network.head.streams).bias.data, bias)
        wanted.append(learner.loss(sample.clone())["target"])
    torch.testing.assert_close(wanted[0], wanted[1], atol=1e-3, rtol=1e-3)


def _raise_second(bias, by):
    """Raises the advantage of the second of two actions, and the value so that that of the first stays."""
    streams = bias.view(-1, 3)
    streams[:, 2] += by
    streams[:, 0] += by / 2
