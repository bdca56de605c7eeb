"""Builders refuse environments that do not fit, with one message that lists every problem."""

import pickle
import re
from dataclasses import replace
from functools import partial

import gymnasium
import pytest
import torch
from helpers import ALGORITHMS, build, collect, small_env
from torchrl.data import Binary, Bounded, Categorical, Composite, MultiCategorical, MultiOneHot, OneHot, Unbounded
from torchrl.envs import DTypeCastTransform, GymWrapper, ParallelEnv, RenameTransform, SerialEnv, TransformedEnv
from user_envs import Corridor, Walk

from hdrqn_torchrl.algorithms import make_dqn, make_drqn, make_hdqn, make_hdrqn, make_v3
from hdrqn_torchrl.envs import make_montezuma
from hdrqn_torchrl.learning import LearnerSettings
from hdrqn_torchrl.modules import Architecture, Features, FullyConnectedFeatures, compact_network

EVERY = [*ALGORITHMS, "v3"]


class _Flattened(Features):
    """Observations ``[2, 4]`` through one dense layer."""

    out_features = 8

    def __init__(self):
        super().__init__()
        self.dense = torch.nn.Linear(8, 8)

    def forward(self, observation):
        return self.dense(observation.flatten(-2))


N = 4
PLAIN = Architecture(
    hidden_size=8,
    observation_features=lambda spec: FullyConnectedFeatures(spec.shape[-1], (8,)),
    vector_features=lambda size: FullyConnectedFeatures(size, (8,)),
)


def cart_pole(**settings):
    return GymWrapper(gymnasium.make("CartPole-v1"), **settings)


def walk(*, in_info, read=False):
    env = GymWrapper(Walk(in_info=in_info), categorical_action_encoding=True)
    return env.auto_register_info_dict() if read else env


def refusal(name, env):
    """The error message of a builder."""
    with pytest.raises(ValueError) as raised:
        build(name, env)
    return str(raised.value)


@pytest.mark.parametrize("builder", [make_dqn, make_drqn, make_hdqn, make_hdrqn, make_v3])
@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((Corridor, PLAIN), "env must be a TorchRL environment (EnvBase), got <class"),
        ((gymnasium.make("CartPole-v1"), PLAIN), "env must be a TorchRL environment (EnvBase), got <TimeLimit"),
        ((small_env(N), compact_network), "architecture must be an Architecture, got <function compact_network"),
        ((small_env(N), torch.nn.Linear(3, 3)), "architecture must be an Architecture, got Linear("),
    ],
    ids=["class", "gymnasium", "not called", "module"],
)
def test_arguments_of_another_kind_are_refused(builder, given, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        builder(*given)


def test_an_environment_without_worlds_is_refused():
    assert "the batch size must be [N] with N >= 1, got [0]; use 16 environments" in refusal("v2", Corridor(0))


@pytest.mark.parametrize("total_frames", [0, "800", 1e5])
def test_total_frames_that_is_no_whole_number_from_1_on_is_refused(total_frames):
    with pytest.raises(ValueError, match=rf"total_frames must be .*>= 1, got {total_frames!r}; "):
        make_v3(small_env(N), compact_network(), total_frames=total_frames)


@pytest.mark.parametrize("name, argument", [("dqn", "learner"), ("v3", "learner"), ("hdqn", "sub"), ("v2", "middle")])
def test_learners_settings_of_another_kind_are_refused(name, argument):
    builders = {"dqn": make_dqn, "v3": make_v3, "hdqn": make_hdqn, "v2": make_hdrqn}
    with pytest.raises(ValueError, match=rf"^{argument} must be LearnerSettings, got \{{'tau': 0.1\}}; "):
        builders[name](small_env(N), PLAIN, **{argument: {"tau": 0.1}})
    with pytest.raises(ValueError, match=r"^tau must be a number, got '0.1'; use 0.003"):
        LearnerSettings(tau="0.1")


def test_a_bonus_for_subgoals_asks_for_some():
    with pytest.raises(ValueError, match=r"'attained' must be .* it is missing: the task states no subgoals"):
        make_v3(Corridor(N, without=("attained",)), PLAIN, levels=1, bonus_reward=1.0)


@pytest.mark.parametrize("name", EVERY)
def test_a_policy_in_a_bare_environment_says_where_it_must_act(name):
    env = small_env(N)
    with pytest.raises(KeyError, match=r"is missing: the policy must act in agent\.transform\(env\)"):
        env.rollout(2, build(name, env).policy)


class TestActions:
    @pytest.mark.parametrize("name", EVERY)
    def test_one_hot_actions_are_refused_with_a_remedy(self, name):
        message = refusal(name, Corridor(N, odd={"action": OneHot(2, shape=(N, 2))}))
        assert "'action' must be one integer below n, [4] int64 (Categorical), got [4, 2] bool (OneHot)" in message
        assert "pass categorical_action_encoding=True to GymEnv or GymWrapper" in message

    def test_gym_wrapper_is_refused_only_with_its_default_action_encoding(self):
        assert "categorical_action_encoding" in refusal("dqn", SerialEnv(2, cart_pole))
        build("dqn", SerialEnv(2, partial(cart_pole, categorical_action_encoding=True)))

    @pytest.mark.parametrize(
        ("spec", "remedy"),
        [
            (MultiCategorical([2, 3], shape=(N, 2)), "number the combinations of its parts"),
            (MultiOneHot([2, 3], shape=(N, 5)), "number the combinations of its parts"),
            (Bounded(-1, 1, shape=(N, 2)), "ActionDiscretizer"),
            (Binary(shape=(N, 3), dtype=torch.int8), "number the combinations of its bits"),
            (Categorical(2, shape=(N, 1)), "give it the environment's batch size"),
        ],
        ids=lambda value: type(value).__name__,
    )
    def test_actions_that_are_not_one_integer_are_refused(self, spec, remedy):
        assert remedy in refusal("v2", Corridor(N, odd={"action": spec}))


class TestObservations:
    @pytest.mark.parametrize("name", EVERY)
    @pytest.mark.parametrize(
        "spec",
        [
            Unbounded(shape=(N, 4), dtype=torch.float64),
            Unbounded(shape=(N, 4), dtype=torch.int64),
            Bounded(0, 255, shape=(N, 44, 44), dtype=torch.uint8),
            Bounded(0, 255, shape=(N, 44, 44, 3), dtype=torch.uint8),
            Bounded(0, 255, shape=(N, 3, 44, 44), dtype=torch.int32),
            Bounded(0, 255, shape=(N, 3, 44, 44), dtype=torch.float32),
        ],
        ids=["float64", "int64 without bounds", "no channels", "HWC", "int32 image", "0 to 255"],
    )
    def test_observations_that_networks_cannot_read_are_refused(self, name, spec):
        message = refusal(name, Corridor(N, without=("success",), odd={"observation": spec}))
        assert "'observation' must be a square of cell codes [V, V] (Categorical, integers), other codes" in message
        assert f"got {list(spec.shape)} {str(spec.dtype).removeprefix('torch.')} ({type(spec).__name__})" in message

    @pytest.mark.parametrize(
        "spec",
        [
            Categorical(5, shape=(N, 3, 3), dtype=torch.int64),
            Bounded(0, 255, shape=(N, 1, 33, 33), dtype=torch.uint8),
            Bounded(0, 255, shape=(N, 4, 10, 7), dtype=torch.uint8),
            Unbounded(shape=(N, 2, 40, 40)),
            Unbounded(shape=(N, 4)),
            MultiCategorical([5, 3], shape=(N, 2), dtype=torch.uint8),
            Categorical(5, shape=(N, 3, 4), dtype=torch.uint8),
            Categorical(5, shape=(N,), dtype=torch.int64),
        ],
        ids=["int64 cells", "grey", "small image", "floats", "vector", "codes", "3x4 cells", "number"],
    )
    @pytest.mark.parametrize("name", ["dqn", "v2", "v3"])
    def test_agents_learn_from_every_observation_that_networks_can_read(self, name, spec):
        env = Corridor(N, odd={"observation": spec})
        algorithm = build(name, env)
        algorithm.observe(collect(algorithm, env, 16)[0])
        for learner in algorithm.learners.values():
            assert torch.isfinite(learner.learn()["loss"])

    def test_a_custom_architecture_may_read_any_observation(self):
        env = Corridor(N, odd={"observation": Unbounded(shape=(N, 4))})
        algorithm = build("v2", env, PLAIN)
        algorithm.observe(collect(algorithm, env, 16)[0])
        assert torch.isfinite(algorithm.learners["sub"].update(algorithm.learners["sub"].sample())["loss"])

    @pytest.mark.parametrize("name", ["drqn", "v2", "v3"])
    def test_observations_without_decoder_cannot_be_predicted(self, name):
        env = Corridor(N, odd={"observation": Unbounded(shape=(N, 2, 4))})
        plain = replace(PLAIN, observation_features=lambda spec: _Flattened())
        with pytest.raises(ValueError, match=r"prediction_steps must be 0 if .*, got 3 for \[4, 2, 4\]"):
            build(name, env, plain, prediction_steps=3)
        build(name, env, plain, prediction_steps=0)

    @pytest.mark.parametrize("dtype", [torch.uint8, torch.int64])
    def test_codes_are_stored_as_small_as_the_environment_writes_them(self, dtype):
        env = Corridor(N, odd={"observation": MultiCategorical([5, 3], shape=(N, 2), dtype=dtype)})
        algorithm = build("v3", env)
        algorithm.observe(collect(algorithm, env, 16)[0])
        assert algorithm.learners["joint"].sample()["observation"].dtype == dtype

    def test_a_dictionary_instead_of_an_observation_is_refused_by_its_parts(self):
        parts = Composite({"view": Unbounded(shape=(N, 4)), "words": Categorical(9, shape=(N, 3))}, shape=(N,))
        message = refusal("v2", Corridor(N, odd={"observation": parts}))
        assert (
            "'observation' must be what the agent sees, it is made of several, ['view', 'words']: join them" in message
        )


class TestGymnasium:
    """The ways in which Gymnasium can report subgoals, as TorchRL reads them."""

    def walks(self, kind):
        if kind == "info":
            return SerialEnv(2, partial(walk, in_info=True, read=True))
        if kind == "dictionary":
            return SerialEnv(2, partial(walk, in_info=False))
        mode, in_info = gymnasium.vector.AutoresetMode[kind.split()[0]], kind.endswith("info")
        vector = gymnasium.vector.SyncVectorEnv([partial(Walk, in_info=in_info)] * 2, autoreset_mode=mode)
        env = GymWrapper(vector, categorical_action_encoding=True)
        return env.auto_register_info_dict() if in_info else env

    @pytest.mark.parametrize("kind", ["info", "dictionary", "DISABLED", "DISABLED info"])
    @pytest.mark.parametrize("name", ["v2", "v3"])
    def test_agents_learn_from_subgoals_that_gymnasium_reports(self, name, kind):
        env = self.walks(kind)
        algorithm = build(name, env, PLAIN, prediction_steps=0)
        assert algorithm.learners and not algorithm.task.ordered
        for batch in collect(algorithm, env, 9, 2):
            algorithm.observe(batch)
            assert (batch["next", "attained"].any(-1, keepdim=True) == (batch["next", "extrinsic_reward"] == 1)).all()
            assert batch["next", "attained"].any() and batch["next", "option_done"][batch["next", "done"]].all()
        for learner in algorithm.learners.values():
            assert torch.isfinite(learner.learn()["loss"])

    def test_same_step_autoreset_is_accepted_for_plain_observations_only(self):
        message = refusal("v2", self.walks("SAME_STEP"))
        assert "must be DISABLED, got SAME_STEP; pass AutoresetMode.DISABLED" in message
        vector = gymnasium.make_vec(
            "CartPole-v1", 2, "sync", {"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}
        )
        env = GymWrapper(vector, categorical_action_encoding=True)
        algorithm = build("drqn", env, PLAIN)
        batch = collect(algorithm, env, 60)[0]
        algorithm.observe(batch)
        done, start = batch["next", "done"][:, :-1], batch["is_init"][:, 1:]
        assert done.any() and (done == start).all()
        assert batch["next", "observation"][batch["next", "terminated"].squeeze(-1)].abs().amax(-1).min() > 0.2
        assert batch["observation"][batch["is_init"].squeeze(-1)].abs().max() <= 0.05  # CartPole's starts


class TestEntries:
    @pytest.mark.parametrize("name", ["hdqn", "v1", "v2", "v3"])
    def test_one_error_lists_all_problems_and_all_entries(self, name):
        odd = {
            "attained": Binary(shape=(N, 2), dtype=torch.int8),
            "hazard": Binary(shape=(N, 2), dtype=torch.bool),
            "success": Binary(shape=(N, 1), dtype=torch.int8),
            "reward": Unbounded(shape=(N, 1), dtype=torch.float64),
        }
        message = refusal(name, Corridor(N, without=("extrinsic_reward",), odd=odd))
        for problem in (
            "'attained' must be [4, G] bool, got [4, 2] int8 (Binary); cast it",
            "'hazard' must be [4, 1] bool, got [4, 2] bool (Binary)",
            "'success' must be [4, 1] bool, got [4, 1] int8 (Binary); cast it",
            "'reward' must be [4, 1] float32, got [4, 1] float64 (Unbounded",
            "'extrinsic_reward' must be [4, 1] float32, it is missing",
            "'observation': [4, 1, 1] uint8 (Categorical)",
        ):
            assert problem in message

    def test_only_hierarchical_agents_need_attained(self):
        env = Corridor(N, without=("attained", "extrinsic_reward", "hazard", "success"))
        assert "'attained' must be [4, G] bool, it is missing" in refusal("v3", env)
        for name in ("dqn", "drqn"):
            algorithm = build(name, env)
            algorithm.observe(collect(algorithm, env, 16)[0])
            assert torch.isfinite(algorithm.learners["flat"].update(algorithm.learners["flat"].sample())["loss"])

    @pytest.mark.parametrize(
        ("num_envs", "remedy"), [(None, r"SerialEnv(16, make_env)"), (2, "not a batch of batches")]
    )
    @pytest.mark.parametrize("name", EVERY)
    def test_the_batch_size_must_have_one_dimension(self, name, num_envs, remedy):
        env = Corridor(None) if num_envs is None else ParallelEnv(3, lambda: small_env(num_envs))
        assert remedy in refusal(name, env)

    def test_the_remedies_in_the_errors_work(self):
        env = Corridor(N, odd={"attained": Binary(shape=(N, 2), dtype=torch.int8)})
        cast = DTypeCastTransform(dtype_in=torch.int8, dtype_out=torch.bool, in_keys=["attained"])
        build("v3", TransformedEnv(env, cast))
        env = TransformedEnv(small_env(N), RenameTransform(["observation"], ["view"]))
        assert "'observation' must be what the agent sees, it is missing" in refusal("dqn", env)
        build("dqn", TransformedEnv(env, RenameTransform(["view"], ["observation"])))


@pytest.mark.parametrize(
    ("without", "options"),
    [(("hazard", "success"), {"hazard_reward": 0.0}), (("hazard", "success", "truncated"), {})],
    ids=["success", "truncated"],
)
@pytest.mark.parametrize("name", [*EVERY, "hindsight"])
def test_agents_learn_without_optional_entries(name, options, without):
    env = Corridor(N, without=without)
    if name == "hindsight":
        name, options = "v2", {**options, "sub_hindsight": True, "meta_hindsight": True}
    elif name in ("dqn", "drqn"):
        options = {}
    algorithm = build(name, env, **options)
    for batch in collect(algorithm, env, 8, 2):
        algorithm.observe(batch)
    for learner in algorithm.learners.values():
        assert torch.isfinite(learner.learn()["loss"])


@pytest.mark.parametrize("name", EVERY)
def test_make_transforms_can_be_pickled_and_holds_no_environment(name):
    algorithm = build(name, small_env(N))
    sent = pickle.dumps(algorithm.make_transforms)
    assert b"hdrqn_torchrl.envs" not in sent and b"modules.q_network" not in sent
    env = small_env(N)
    torch.manual_seed(0)
    expected = algorithm.transform(small_env(N)).rollout(9, algorithm.policy, break_when_any_done=False)
    torch.manual_seed(0)
    found = TransformedEnv(env, pickle.loads(sent)()).rollout(9, algorithm.policy, break_when_any_done=False)
    assert (expected == found).all()


def test_errors_name_make_v3():
    with pytest.raises(ValueError, match=r"^env must have what make_v3 reads:\n"):
        make_v3(Corridor(None), compact_network(8))


def test_make_transforms_of_v3_on_montezuma_can_be_pickled():
    pytest.importorskip("ale_py")
    env = make_montezuma(1, seed=0)
    make_transforms = pickle.loads(pickle.dumps(build("v3", env).make_transforms))
    seen = TransformedEnv(make_montezuma(1, seed=0), make_transforms())
    assert seen.reset()["subgoal_mask"].shape == (1, 6)
