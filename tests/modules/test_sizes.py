"""Every number that a module is built from has a rule, and the message names argument, rule, value and a way out."""

import math

import pytest

from hdrqn_torchrl.algorithms import make_v3
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.modules import (
    AllSubgoalsNetwork,
    AllSubgoalsPolicy,
    CellDecoder,
    CellFeatures,
    CellsToImage,
    ConvFeatures,
    EpsilonGreedy,
    FullyConnectedFeatures,
    HierarchicalPolicy,
    ImageDecoder,
    MetaController,
    ObservationPredictor,
    QNetwork,
    RepeatingEpsilonGreedy,
    SubController,
    SubgoalSuccess,
    SuccessEpsilonGreedy,
    compact_network,
    paper_network,
)

FEATURES = FullyConnectedFeatures(4, (4,))
VALID = {
    AllSubgoalsNetwork: {"features": FEATURES, "num_actions": 2, "num_subgoals": 2, "hidden_size": 4, "head_size": 4},
    QNetwork: {"features": FEATURES, "num_actions": 2, "hidden_size": 4},
    CellsToImage: {"view": 3, "num_codes": 5, "size": 8},
    ConvFeatures: {"in_channels": 1, "size": 33, "out_features": 4},
    CellFeatures: {"view": 3, "num_codes": 5},
    FullyConnectedFeatures: {"in_features": 4},
    CellDecoder: {"in_features": 4, "view": 3, "num_codes": 5},
    ImageDecoder: {"in_features": 4, "channels": 1, "size": 3},
    ObservationPredictor: {
        "make_decoder": lambda size: CellDecoder(size, 3, 5),
        "hidden_size": 4,
        "num_actions": 2,
        "max_steps": 2,
        "width": 4,
    },
    SubgoalSuccess: {"num_subgoals": 2, "window": 10},
    SuccessEpsilonGreedy: {"window": 10, "max_repeats": 2, "anneal_frames": 5},
    RepeatingEpsilonGreedy: {"max_repeats": 2, "anneal_frames": 5},
    EpsilonGreedy: {"anneal_frames": 5},
    compact_network: {"hidden_size": 4},
    paper_network: {"hidden_size": 4},
}
SIZES = [(make, name) for make, valid in VALID.items() for name, value in valid.items() if isinstance(value, int)]


@pytest.mark.parametrize(("make", "name"), SIZES, ids=lambda part: getattr(part, "__name__", part))
@pytest.mark.parametrize("wrong", [0, -3, 1.5, True, None, "x"], ids=repr)
def test_sizes_are_whole_and_positive(make, name, wrong):
    make(**VALID[make])
    with pytest.raises(ValueError, match=rf"^{name} must be .* got {wrong!r}; .+\.$"):
        make(**(VALID[make] | {name: wrong}))


@pytest.mark.parametrize("make", [compact_network, FullyConnectedFeatures, CellFeatures])
@pytest.mark.parametrize(
    ("widths", "told"),
    [
        ([], r"widths must be a list of at least one size, got \[\]; use"),
        (64, "widths must be a list of at least one size, got 64; use"),
        ("64", "widths must be a list of at least one size, got '64'; use"),
        (["x"], r"widths\[0\] must be a whole number >= 1, got 'x'; use"),
        ([8, 0], r"widths\[1\] must be >= 1, got 0; use"),
    ],
)
def test_widths(make, widths, told):
    with pytest.raises(ValueError, match=told):
        make(**(VALID[make] | {"widths": widths}))


def test_four_convolutions():
    with pytest.raises(ValueError, match="channels must be four sizes, got 3; "):
        ConvFeatures(channels=(1, 2, 3))


@pytest.mark.parametrize("wrong", [-1, 1.5])
def test_no_condition_and_no_prediction_are_sizes_too(wrong):
    for change in ({"num_conditions": wrong}, {"prediction_steps": wrong}):
        (name,) = change
        with pytest.raises(ValueError, match=f"{name} must be .*>= 0, got {wrong}; "):
            compact_network(4, (4,)).q_network(4, num_actions=2, **change)


@pytest.mark.parametrize("wrong", [-0.5, math.nan, math.inf])
def test_what_spreads_and_bends_is_finite(wrong):
    for make, name in ((EpsilonGreedy, "ladder"), (RepeatingEpsilonGreedy, "exponent"), (EpsilonGreedy, "start")):
        with pytest.raises(ValueError, match=f"{name} must .* got {wrong}; "):
            make(**{name: wrong})


class TestControllers:
    """What does not fit each other is told when it is put together."""

    def network(self, num_actions=2, num_conditions=0, recurrent=True):
        return QNetwork(
            FEATURES, num_actions=num_actions, hidden_size=4, num_conditions=num_conditions, recurrent=recurrent
        )

    def test_an_exploration_is_one(self):
        network = AllSubgoalsNetwork(FEATURES, num_actions=2, num_subgoals=2)
        for make in (
            lambda wrong: MetaController(self.network(), wrong),
            lambda wrong: SubController(self.network(num_conditions=2), wrong),
            lambda wrong: AllSubgoalsPolicy(network, wrong),
            lambda wrong: AllSubgoalsPolicy(network, None, wrong),
        ):
            with pytest.raises(ValueError, match=r"exploration must be an EpsilonGreedy or None, got 0\.1; "):
                make(0.1)

    def test_a_meta_controller_is_told_no_subgoal(self):
        with pytest.raises(ValueError, match="network must have no condition, got num_conditions=2; "):
            MetaController(self.network(num_conditions=2))

    @pytest.mark.parametrize("wrong", [[], "observation"])
    def test_a_meta_controller_reads_something(self, wrong):
        with pytest.raises(ValueError, match=r"input_keys must be a list of at least one entry, got .*; "):
            MetaController(self.network(), input_keys=wrong)

    def test_both_levels_know_the_same_subgoals(self):
        with pytest.raises(ValueError, match="as many conditions as the meta_controller has subgoals, got 2 and 3; "):
            HierarchicalPolicy(MetaController(self.network(3)), SubController(self.network(2, 2)))

    def test_each_level_has_a_schedule_of_its_own(self):
        shared = EpsilonGreedy()
        for make in (
            lambda: AllSubgoalsPolicy(AllSubgoalsNetwork(FEATURES, num_actions=2, num_subgoals=2), shared, shared),
            lambda: HierarchicalPolicy(
                MetaController(self.network(), shared), SubController(self.network(2, 2), shared)
            ),
        ):
            with pytest.raises(ValueError, match="meta_exploration must not be the sub level's, got one EpsilonGreedy"):
                make()

    def test_without_a_state_there_is_none_to_advance(self):
        sub = SubController(self.network(2, 2, recurrent=False))
        with pytest.raises(ValueError, match="read_last_observation must be False without recurrence"):
            HierarchicalPolicy(MetaController(self.network()), sub, read_last_observation=True)


@pytest.mark.parametrize("name", ["memory_size", "head_size", "prediction_steps"])
def test_a_builder_names_its_own_arguments(name):
    env = MultiGoalGridEnv(num_envs=2)
    with pytest.raises(ValueError, match=rf"^{name} must be >= [01], got -1; "):
        make_v3(env, compact_network(4, (4,)), **{name: -1})
