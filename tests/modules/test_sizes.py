"""Every number that modules are built from is checked; errors name argument, rule, value and remedy."""

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
def test_sizes_must_be_positive_integers(make, name, wrong):
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
def test_wrong_widths_are_refused(make, widths, told):
    with pytest.raises(ValueError, match=told):
        make(**(VALID[make] | {"widths": widths}))


def test_channels_must_be_four_sizes():
    with pytest.raises(ValueError, match="channels must be four sizes, got 3; "):
        ConvFeatures(channels=(1, 2, 3))


@pytest.mark.parametrize("wrong", [-1, 1.5])
def test_zero_conditions_and_zero_prediction_steps_are_accepted(wrong):
    for change in ({"num_conditions": wrong}, {"prediction_steps": wrong}):
        (name,) = change
        with pytest.raises(ValueError, match=f"{name} must be .*>= 0, got {wrong}; "):
            compact_network(4, (4,)).q_network(4, num_actions=2, **change)


@pytest.mark.parametrize("wrong", [-0.5, math.nan, math.inf])
def test_exploration_parameters_must_be_finite_and_not_negative(wrong):
    for make, name in ((EpsilonGreedy, "ladder"), (RepeatingEpsilonGreedy, "exponent"), (EpsilonGreedy, "start")):
        with pytest.raises(ValueError, match=f"{name} must .* got {wrong}; "):
            make(**{name: wrong})


class TestControllers:
    """Parts that do not fit together are refused when they are combined."""

    def network(self, num_actions=2, num_conditions=0, recurrent=True):
        return QNetwork(
            FEATURES, num_actions=num_actions, hidden_size=4, num_conditions=num_conditions, recurrent=recurrent
        )

    def test_an_exploration_of_another_type_is_refused(self):
        network = AllSubgoalsNetwork(FEATURES, num_actions=2, num_subgoals=2)
        for make in (
            lambda wrong: MetaController(self.network(), wrong),
            lambda wrong: SubController(self.network(num_conditions=2), wrong),
            lambda wrong: AllSubgoalsPolicy(network, wrong),
            lambda wrong: AllSubgoalsPolicy(network, None, wrong),
        ):
            with pytest.raises(ValueError, match=r"exploration must be an EpsilonGreedy or None, got 0\.1; "):
                make(0.1)

    def test_a_meta_controller_at_the_top_has_no_condition_and_one_below_another_level_has(self):
        rule = r"condition_key and init_key must be None exactly when the network has no condition, got "
        with pytest.raises(ValueError, match=rule + r"condition_key=None, init_key=None and num_conditions=2; "):
            MetaController(self.network(num_conditions=2))
        with pytest.raises(ValueError, match=rule + r"condition_key='a', init_key='b' and num_conditions=0; "):
            MetaController(self.network(), condition_key="a", init_key="b")

    @pytest.mark.parametrize("wrong", [[], "observation"])
    def test_a_meta_controller_must_have_input_keys(self, wrong):
        with pytest.raises(ValueError, match=r"input_keys must be a list of at least one entry, got .*; "):
            MetaController(self.network(), input_keys=wrong)

    def test_both_levels_must_have_the_same_number_of_subgoals(self):
        with pytest.raises(
            ValueError, match="as many conditions as the meta_controller above it has subgoals, got 2 and 3; "
        ):
            HierarchicalPolicy(MetaController(self.network(3)), SubController(self.network(2, 2)))

    def test_two_levels_must_not_share_an_exploration(self):
        shared = EpsilonGreedy()
        for make in (
            lambda: AllSubgoalsPolicy(AllSubgoalsNetwork(FEATURES, num_actions=2, num_subgoals=2), shared, shared),
            lambda: HierarchicalPolicy(
                MetaController(self.network(), shared), SubController(self.network(2, 2), shared)
            ),
        ):
            with pytest.raises(ValueError, match="meta_exploration must not be the sub level's, got one EpsilonGreedy"):
                make()

    def test_reading_the_last_observation_needs_recurrence(self):
        sub = SubController(self.network(2, 2, recurrent=False))
        with pytest.raises(ValueError, match="read_last_observation must be False without recurrence"):
            HierarchicalPolicy(MetaController(self.network()), sub, read_last_observation=True)


@pytest.mark.parametrize("name", ["memory_size", "head_size", "prediction_steps"])
def test_errors_of_a_builder_name_its_own_arguments(name):
    env = MultiGoalGridEnv(num_envs=2)
    with pytest.raises(ValueError, match=rf"^{name} must be >= [01], got -1; "):
        make_v3(env, compact_network(4, (4,)), **{name: -1})
