import math
from copy import deepcopy
from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers import ALGORITHMS, build, collect, make_collector, parameter_distance, small_env, tiny_settings
from hydra import compose, initialize_config_dir
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type
from user_envs import Corridor

from hdrqn_torchrl.algorithms import V3_LEARNER, make_drqn, make_hdqn, make_hdrqn, make_v3
from hdrqn_torchrl.cli import configuration
from hdrqn_torchrl.data import FROM_STARTS, make_sequence_buffer, sample_sequences
from hdrqn_torchrl.envs import MultiGoalGridEnv, Task
from hdrqn_torchrl.modules import (
    EpsilonGreedy,
    RepeatingEpsilonGreedy,
    SuccessEpsilonGreedy,
    compact_network,
    paper_network,
)
from hdrqn_torchrl.runs.settings.building import build_algorithm

NETWORKS = {"compact": compact_network(8, (8,)), "paper": paper_network(8)}


PLAIN = [(name, {}) for name in ("dqn", "drqn", "hdqn", "v1", "v2", "v3")]
CHANGED = [
    ("v2", {"meta_input": "cell"}),
    ("v2", {"meta_input": "both"}),
    ("v2", {"meta_input_time": "after_last_observation"}),
    *((name, {"sub_hindsight": True, "meta_hindsight": True}) for name in ("hdqn", "v1", "v2")),
]


@pytest.mark.parametrize(
    ("name", "options", "network"),
    [*((*each, "compact") for each in PLAIN + CHANGED), *((*each, "paper") for each in PLAIN)],
    ids=lambda value: value if isinstance(value, str) else "-".join(str(option) for option in value.values()),
)
def test_every_algorithm_collects_and_updates_each_level(name, options, network):
    torch.manual_seed(0)
    layout = {"compact": "open", "paper": "four_rooms"}[network]
    env = MultiGoalGridEnv(4, layout=layout, max_steps=6, seed=0)
    algorithm = build(name, env, NETWORKS[network], settings=tiny_settings(batch_size=16), **options)
    learners = {"dqn": ["flat"], "drqn": ["flat"], "v3": ["joint"]}
    assert list(algorithm.learners) == learners.get(name, ["sub", "meta"])
    assert list(algorithm.explorations) == (["sub", "meta"] if name == "v3" else list(algorithm.learners))
    batch = collect(algorithm, env, 8)[0]
    for learner in algorithm.learners.values():
        before = [p.detach().clone() for p in learner.network.parameters()]
        learner.store(batch)
        metrics = learner.learn()
        assert metrics["loss"] > 0 and metrics["trained_steps"] > 0
        assert any((p != old).any() for p, old in zip(learner.network.parameters(), before, strict=True))


@pytest.mark.parametrize(
    ("settings", "options", "message"),
    [
        (
            {"n_step": 2},
            {"sub_hindsight": True},
            r"sub\.n_step must be 1 with sub_hindsight=True, got 2",
        ),
        (
            {"priority_exponent": 0.9},
            {"sub_hindsight": True},
            r"sub\.priority_exponent must be None with sub_",
        ),
        ({"stored_state": True}, {"sub_hindsight": True}, r"sub\.stored_state must be False with sub_hindsight=True"),
        (
            {"stored_state": True},
            {"meta_hindsight": True},
            r"meta\.stored_state must be False with meta_",
        ),
    ],
    ids=["n_step", "priorities", "sub-states", "meta-states"],
)
def test_settings_incompatible_with_hindsight_are_refused(settings, options, message):
    with pytest.raises(ValueError, match=message):
        build("v2", small_env(4), settings=tiny_settings(**settings), **options)


@pytest.mark.parametrize("name", [*ALGORITHMS, "v3"])
def test_the_transformed_environment_passes_check_env_specs(name):
    env = small_env(3)
    check_env_specs(build(name, env).transform(env))


@pytest.mark.parametrize("name", [*ALGORITHMS, "v3"])
def test_the_policy_shares_its_parameters_with_the_learners(name):
    algorithm = build(name, small_env(3))
    trained = {id(p) for learner in algorithm.learners.values() for p in learner.network.parameters()}
    assert trained == {id(p) for p in algorithm.policy.parameters()}
    epsilons = {id(level.epsilon) for level in algorithm.explorations.values()}
    assert epsilons <= {id(buffer) for buffer in algorithm.policy.buffers()}


def unbounded():
    """Settings of a learner without bounds of targets."""
    return tiny_settings(max_target="unbounded")


def value_everything_at(learner, value):
    """Makes all Q-values of the target network equal to ``value``."""
    streams = learner.loss.target_value_network_params["network", "head", "streams"]
    with torch.no_grad():
        for parameter in streams.values():
            parameter.zero_()
        streams["bias"][0] = value


def learner_ends(learner):
    keys = learner.loss.tensor_keys
    return keys.done, keys.terminated


class TestBoundsOfTargets:
    """Targets are bounded by what the task states, and by nothing else."""

    def bound(self, algorithm, level):
        loss = algorithm.learners[level].loss
        return loss.rules[-1].largest_return if level == "joint" else loss.max_target

    @pytest.mark.parametrize(("name", "level"), [("dqn", "flat"), ("drqn", "flat"), ("v1", "meta"), ("v2", "meta")])
    def test_the_grid_task_bounds_returns_by_one_per_goal(self, name, level):
        algorithm = build(name, small_env(2, num_goals=3))
        assert self.bound(algorithm, level) == 3.0
        settings = tiny_settings(max_target=0.5)
        assert self.bound(build(name, small_env(2), settings=settings), level) == 0.5

    @pytest.mark.parametrize("name", ["v1", "v2", "hdqn"])
    def test_the_meta_level_s_targets_are_bounded_from_below_too(self, name):
        losses = [learner.loss for learner in build(name, small_env(2)).learners.values()]
        assert [loss.min_target for loss in losses] == [-math.inf, 0.0]
        free = build(name, small_env(2), settings=tiny_settings(max_target="unbounded")).learners["meta"].loss
        assert (free.min_target, free.max_target) == (-math.inf, math.inf)

    def test_the_grid_task_bounds_targets_of_v3_on_both_sides(self):
        loss = build("v3", small_env(2, num_goals=3)).learners["joint"].loss
        sub, meta = loss.rules
        assert (meta.smallest_return, meta.largest_return, sub.largest_return) == (0.0, 3.0, 1.0)
        assert build("v3", small_env(2), max_meta_target=0.5).learners["joint"].loss.rules[1].largest_return == 0.5

    @pytest.mark.parametrize(("rewards", "bound"), [({}, 1.0), ({"wrong_subgoal_reward": 0.5}, math.inf)])
    def test_targets_of_the_sub_level_are_bounded_by_the_largest_intrinsic_return(self, rewards, bound):
        assert self.bound(build("v2", small_env(2), **rewards), "sub") == bound
        assert build("v3", small_env(2), **rewards).learners["joint"].loss.rules[0].largest_return == bound

    @pytest.mark.parametrize("name", ["dqn", "v1", "v3"])
    def test_without_a_stated_return_targets_are_unbounded(self, name):
        level = {"dqn": "flat", "v1": "meta", "v3": "joint"}[name]
        env = Corridor(4, num_goals=2, pays=10.0, without=("success",))
        torch.manual_seed(0)
        options = {"settings": tiny_settings(learning_rate=0.03, tau=0.2)}
        algorithm = build(name, env, **options, **({"meta_gamma": 1.0} if name == "v3" else {"gamma": 1.0}))
        assert self.bound(algorithm, level) == math.inf
        learner = algorithm.learners[level]
        for batch in collect(algorithm, env, 16, 4):
            learner.store(batch)
        for _ in range(300):
            learner.learn()
        value = "meta_q_value" if name == "v3" else "q_value"
        assert learner.learn()[value] > 4.0

    def test_returns_stated_by_a_custom_environment_bound_targets(self):
        task = Task(largest_return=40.0, largest_extrinsic_return=20.0, smallest_extrinsic_return=-5.0)
        env = Corridor(4, pays=10.0, without=("success",), task=task)
        assert self.bound(build("drqn", env), "flat") == 40.0
        assert self.bound(build("v2", env), "meta") == 20.0
        loss = build("v3", env).learners["joint"].loss
        assert (loss.rules[-1].smallest_return, loss.rules[-1].largest_return) == (-5.0, 20.0)


class TestSequencesOfV3:
    """By default, v3 takes their length from the task."""

    def settings(self, env, **changes):
        return make_v3(env, compact_network(8, (8,)), learner=replace(V3_LEARNER, **changes)).learners["joint"].settings

    @pytest.mark.parametrize("sampling", ["episode_starts", "whole_episodes"])
    @pytest.mark.parametrize("steps", [1, 50, 200])
    def test_sequences_are_whole_episodes_of_up_to_200_steps(self, steps, sampling):
        settings = self.settings(small_env(2, max_steps=steps), sampling=sampling)
        assert (settings.slice_len, settings.sampling, settings.stored_state) == (steps, sampling, False)

    @pytest.mark.parametrize("env", [small_env(2, max_steps=201), Corridor(2, length=6)], ids=["long", "unknown"])
    def test_sequences_of_longer_episodes_are_short_and_start_from_stored_states(self, env):
        with pytest.warns(UserWarning, match=r"sequences of 32 steps that begin anywhere, .* give slice_len for"):
            settings = self.settings(env)
        assert (settings.slice_len, settings.sampling, settings.stored_state) == (32, "steps", True)
        assert settings.burn_in == 0.25

    def test_a_given_slice_len_is_kept(self):
        env = small_env(2, max_steps=400)
        assert self.settings(env, slice_len=50) == replace(V3_LEARNER, slice_len=50)
        given = {"sampling": "steps", "stored_state": True, "burn_in": 0.5}
        assert self.settings(env, **given) == replace(V3_LEARNER, slice_len=32, **given)
        with pytest.raises(
            ValueError, match=r"learner\.slice_len must be a number with .*'whole_episodes' and .* up to 400 steps"
        ):
            self.settings(env, sampling="whole_episodes")

    def test_every_step_of_episodes_of_400_steps_is_trained(self):
        """Counts which steps enter the loss, with a memory of two episodes in each environment."""
        env = Corridor(4, length=400, task=Task(max_steps=400))
        torch.manual_seed(0)
        settings = replace(V3_LEARNER, capacity=4 * 850, batch_size=64, warmup_frames=0)
        with pytest.warns(UserWarning, match=r"of up to 400 steps in sequences of 32 steps"):
            algorithm = make_v3(env, compact_network(8, (8,)), learner=settings, memory_size=8, head_size=8)
        learner = algorithm.learners["joint"]
        for batch in collect(algorithm, env, 50, batches=16):
            learner.store(batch)
        counts = torch.zeros(400)
        for _ in range(16):
            sample = learner.sample()
            sample["subgoal_mask"].fill_(True)  # both ends are soon attained, and nothing is left to learn about
            loss, valid = learner.loss, sample["collector", "mask"]
            (online, target, _), events = loss._values(sample), loss._events(sample, valid)
            columns = loss.targets.columns(online, target, sample["action"], sample, events)
            warm = loss._warm(valid[:, :-1], sample["is_init"].squeeze(-1)[:, :-1], loss.lookahead - 1)
            trained = columns[0].trained.any(-1) & warm
            assert (trained.sum(-1) <= 32).all()
            counts += (sample["index"][:, :-1, 0] % 400)[trained].bincount(minlength=400)
        assert (counts[:399] > 0).all() and counts[50:].sum() > 6 * counts[:50].sum()


def test_slice_len_must_be_a_number_except_for_v3():
    for name in ("drqn", "v1", "v2"):
        with pytest.raises(ValueError, match="slice_len must be a number, got None; only v3 asks the task"):
            build(name, small_env(2), settings=tiny_settings(slice_len=None))


class TestTasksWithoutEnd:
    @pytest.mark.parametrize(
        ("name", "options"),
        [
            ("hdqn", {}),
            ("v1", {"repeatable_subgoals": True}),
            ("v2", {"meta_hindsight": True, "refresh_hidden_steps": 6}),
        ],
        ids=str,
    )
    def test_the_meta_level_learns_before_an_endless_episode_is_over(self, name, options):
        env = Corridor(4, length=None)
        algorithm = build(name, env, settings=tiny_settings(slice_len=2, capacity=100), max_option_steps=3, **options)
        meta = algorithm.learners["meta"]
        for batch in collect(algorithm, env, 10, batches=12):
            meta.store(batch)
            for _ in range(meta.updates_due()):
                assert meta.update(meta.sample())["loss"].isfinite()
            held = meta.extract.state_dict()["held"]
            assert len(held) <= 4 * 8 * 2
        assert len(meta.buffer) == 100 and meta.updates > 10
        assert meta.buffer.storage[:]["is_init"].sum() <= 4

    def test_only_options_of_long_or_endless_episodes_are_stored_in_pieces(self):
        held = [
            build("v2", small_env(2, max_steps=steps)).learners["meta"].extract.max_held for steps in (50, 1000, 1001)
        ]
        assert held == [1000, 1000, 8 * 4]


class TestOptions:
    """Every option has an effect."""

    def steps(self, batches=1, name="v2", **options):
        torch.manual_seed(0)
        env = small_env(8)
        algorithm = build(name, env, **options)
        batch = torch.cat(collect(algorithm, env, 30, batches), 1)
        return algorithm, batch

    def test_gamma_and_smdp_discount_reach_book_and_loss(self):
        algorithm, batch = self.steps(gamma=0.5)
        gammas = [learner.loss.gamma.item() for learner in algorithm.learners.values()]
        assert gammas == [0.5, 0.5]
        returns = batch["next", "option_return"]
        ends = batch["next", "subgoal_reached"] & (batch["next", "option_steps"] > 1)
        assert ends.any() and (returns[ends] < 1.0).all()
        algorithm, batch = self.steps(gamma=0.5, smdp_discount=False)
        returns, steps = batch["next", "option_return"], batch["next", "option_steps"]
        assert ((returns * 100).round() == returns * 100).all() and (returns[steps > 1] >= 1.0).any()

    @pytest.mark.parametrize(("name", "levels"), [("dqn", 1), ("drqn", 1), ("hdqn", 2), ("v1", 2), ("v2", 2)])
    @pytest.mark.parametrize("settings", [{"trace_decay": 0.5}, {"n_step": 2}], ids=str)
    def test_longer_targets_are_used_at_every_level(self, name, levels, settings):
        algorithm, batch = self.steps(name=name, settings=tiny_settings(batch_size=64, **settings))
        default, _ = self.steps(name=name)
        assert len(algorithm.learners) == levels
        for level, learner in algorithm.learners.items():
            learner.store(batch)
            sample = learner.sample()
            assert sample.shape[1] == 4 + 2  # two steps for the target of the last one that is trained
            changed, usual = learner.loss(sample), default.learners[level].loss(sample[:, : 4 + 1])
            torch.testing.assert_close(changed["q_value"], usual["q_value"])  # the same steps are trained
            assert changed["target"] != usual["target"]

    @pytest.mark.parametrize(("name", "burns"), [("dqn", False), ("hdqn", False), ("drqn", True), ("v1", True)])
    def test_only_networks_with_memory_have_burn_in(self, name, burns):
        """Networks without memory train every step that has a target."""
        algorithm, batch = self.steps(name=name, settings=tiny_settings(batch_size=256))
        for learner in algorithm.learners.values():
            learner.store(batch)
            sample = learner.sample()
            real = sample.get(("collector", "mask"), torch.ones(sample.shape, dtype=torch.bool))
            done, ended = (sample["next", key].squeeze(-1) for key in learner_ends(learner))
            everything = (real[:, :-1] & (ended | ~done & real.roll(-1, 1))[:, :-1]).sum()
            assert (learner.loss(sample)["trained_steps"] < everything) == burns

    @pytest.mark.parametrize(("smdp_discount", "discount"), [(True, 0.5**3), (False, 0.5)])
    def test_smdp_discount_decides_the_discount_of_the_meta_target(self, smdp_discount, discount):
        algorithm, batch = self.steps(gamma=0.5, smdp_discount=smdp_discount, settings=unbounded())
        meta = algorithm.learners["meta"]
        options = meta.extract(batch)[None, :2]
        options["next", "terminated"].fill_(False)
        options["next", "done"].fill_(False)
        options["is_init"].copy_(torch.tensor([[[True], [False]]]))
        options["next", "option_steps"].fill_(3)
        options["next", "option_return"].fill_(0.25)
        value_everything_at(meta, 8.0)
        assert meta.loss(options)["target"].item() == pytest.approx(0.25 + discount * 8)

    @pytest.mark.parametrize("hindsight", [False, True])
    def test_sub_targets_end_at_the_subgoal_and_are_left_out_at_time_limits(self, hindsight):
        """At the limit whatever happened there: of those that fail, what follows is unknown."""
        algorithm, batch = self.steps(gamma=0.5, max_option_steps=2, settings=unbounded(), sub_hindsight=hindsight)
        sub, after = algorithm.learners["sub"], batch["next"]
        value_everything_at(sub, 8.0)
        at_limit = after["option_steps"] == 2
        reached = after["subgoal_reached"] & ~after["terminated"]
        goes_on = ~after["option_done"]
        steps = sub.extract(batch)
        pairs = torch.stack([steps[:, :-1], steps[:, 1:]], 2)
        pairs["option_init"][..., 0, :] = True
        cases = ((reached & ~at_limit, 0.0), (goes_on, 0.5 * 8.0), (reached & at_limit, None), (at_limit, None))
        for rows, following in cases:
            chosen = pairs[rows[:, :-1].squeeze(-1)]
            result = sub.loss(chosen)
            assert len(chosen) and result["trained_steps"] == (0 if following is None else len(chosen))
            if following is not None:
                wanted = chosen["next", "intrinsic_reward"][:, 0].mean().item() + following
                assert result["target"].item() == pytest.approx(wanted, abs=1e-5)

    def test_time_limits_inside_a_sequence_are_left_out_and_the_state_restarts(self):
        algorithm, batch = self.steps(max_option_steps=2)
        sub = algorithm.learners["sub"]
        steps = sub.extract(batch)[:, :5]
        no_end = (~steps["next", "done"][:, :4].any(1) & ~steps["next", "option_terminated"][:, :4].any(1)).squeeze(-1)
        steps = steps[no_end]  # two options of two steps each, and the step after them
        assert len(steps) and steps["next", "option_done"][:, [1, 3]].all()
        assert sub.loss(steps)["trained_steps"] == 2 * len(steps)

    @pytest.mark.parametrize(("mask_reached", "following"), [(True, 2.0), (False, 8.0)])
    def test_the_meta_target_ignores_subgoals_that_are_gone(self, mask_reached, following):
        algorithm, batch = self.steps(mask_reached=mask_reached, smdp_discount=False, gamma=0.5, settings=unbounded())
        meta = algorithm.learners["meta"]
        rows = meta.extract(batch)
        options = torch.stack([rows[:-1], rows[1:]], 1)
        options = options[~options["next", "done"][:, 0].flatten()]  # and not terminated
        options["is_init"].copy_(torch.tensor([[True], [False]]).expand(len(options), 2, 1))
        if mask_reached:
            options["subgoal_mask"][:, 1] = torch.tensor([False, True])
        value_everything_at(meta, 5.0)
        with torch.no_grad():  # Q = V + A - mean(A): 5 + 3 and 5 - 3
            meta.loss.target_value_network_params["network", "head", "streams", "bias"][1] = 6.0
            meta.network.network.head.streams.weight.zero_()
            meta.network.network.head.streams.bias.copy_(torch.tensor([0.0, 1.0, 0.0]))  # prefers subgoal 0
        wanted = options["next", "option_return"][:, 0].mean().item() + 0.5 * following
        assert meta.loss(options)["target"].item() == pytest.approx(wanted)

    def test_mask_reached_removes_attained_subgoals_from_the_mask(self):
        for mask_reached in (True, False):
            _, batch = self.steps(batches=3, mask_reached=mask_reached)
            starts = batch["option_init"].squeeze(-1)
            allowed = batch["subgoal_mask"].gather(-1, batch["subgoal"].unsqueeze(-1))[starts]
            assert allowed.all() == mask_reached

    def test_repeatable_subgoals_stay_in_the_mask(self):
        for repeatable in (True, False):
            _, batch = self.steps(repeatable_subgoals=repeatable)
            assert batch["subgoal_mask"].all() == repeatable

    def test_reward_options_reach_the_critic(self):
        _, batch = self.steps(batches=3)
        assert batch["next", "intrinsic_reward"].unique().tolist() == [-1.0, 0.0, 1.0]
        _, batch = self.steps(batches=3, hazard_reward=-0.25, wrong_subgoal_reward=-0.5)
        assert batch["next", "intrinsic_reward"].unique().tolist() == [-0.5, -0.25, 0.0, 1.0]

    def test_max_option_steps_limits_options(self):
        for limit in (None, 3):
            _, batch = self.steps(max_option_steps=limit)
            assert batch["next", "option_steps"].max() == (limit or 7)

    @pytest.mark.parametrize(
        ("options", "entries"),
        [
            ({"version": "v1"}, {"observation"}),
            ({}, {"sub_hidden"}),
            ({"meta_input": "cell"}, {"sub_cell"}),
            ({"meta_input": "both"}, {"sub_hidden", "sub_cell"}),
        ],
        ids=lambda value: (
            str(value) if isinstance(value, dict) else "-".join(sorted(value))
        ),  # the same in every process
    )
    def test_version_and_meta_input_decide_what_the_meta_controller_reads(self, options, entries):
        options = dict(options)
        algorithm, batch = self.steps(name=options.pop("version", "v2"), **options)
        stored = algorithm.learners["meta"].extract(batch)
        assert entries == {"observation", "sub_hidden", "sub_cell"} & set(stored.keys())

    def test_meta_input_time_decides_which_state_the_meta_controller_reads(self):
        policies = [
            build("v2", small_env(2), meta_input_time=time).policy
            for time in ("after_last_decision", "after_last_observation")
        ]
        assert [policy.read_last_observation for policy in policies] == [False, True]

    def test_settings_and_schedules_reach_their_level(self):
        sub, meta = tiny_settings(slice_len=3), tiny_settings(slice_len=2)
        schedules = EpsilonGreedy(0.5, 0.5), EpsilonGreedy(0.25, 0.25)
        algorithm = make_hdrqn(
            small_env(2),
            NETWORKS["compact"],
            sub=sub,
            meta=meta,
            sub_exploration=schedules[0],
            meta_exploration=schedules[1],
        )
        assert algorithm.learners["sub"].settings is sub and algorithm.learners["meta"].settings is meta
        policy = algorithm.policy
        assert policy.sub_controller.exploration is algorithm.explorations["sub"] is schedules[0]
        assert policy.meta_controller.exploration is algorithm.explorations["meta"] is schedules[1]

    def test_flat_agents_learn_from_the_total_reward(self):
        algorithm, batch = self.steps(name="drqn")
        stored = algorithm.learners["flat"].extract(batch)
        assert (stored["next", "reward"] == batch["next", "reward"]).all()
        assert (batch["next", "reward"] == -1).any()

    def test_sub_and_meta_learn_from_their_own_rewards(self):
        algorithm, batch = self.steps()
        sub, meta = (algorithm.learners[level].extract(batch) for level in ("sub", "meta"))
        assert (sub["next", "intrinsic_reward"] == batch["next", "intrinsic_reward"]).all()
        assert not any("reward" in stored["next"] for stored in (sub, meta))
        assert meta["next", "option_return"].min() >= 0  # obstacles are no business of the meta-controller

    @pytest.mark.parametrize(
        ("make", "options", "message"),
        [
            (make_hdrqn, {"version": "v9"}, "version must be 'v1' or 'v2', got 'v9'; "),
            (
                make_hdrqn,
                {"version": "v2", "recurrent": False},
                "recurrent must be True with version='v2', got False.*; ",
            ),
            (make_hdrqn, {"meta_input": "all"}, "meta_input must be one of .*, got 'all'; "),
            (make_hdrqn, {"version": "v1", "meta_input": "cell"}, "meta_input must be left at 'hidden' with .*'cell'"),
            (make_hdrqn, {"version": "v1", "refresh_hidden_steps": 5}, "refresh_hidden_steps must be left at None"),
            (make_v3, {"levels": 1, "joint": False}, "joint must be True with levels=1, got False: there is no meta"),
            (make_hdrqn, {"meta_input_time": "never"}, "meta_input_time must be .*, got 'never'; "),
            (make_hdqn, {"gamma": 2.0}, r"gamma must lie in \[0, 1\], got 2.0; "),
        ],
    )
    def test_wrong_arguments_are_refused(self, make, options, message):
        with pytest.raises(ValueError, match=message):
            make(small_env(2), NETWORKS["compact"], **options)


def test_short_options_and_short_episodes_are_trained():
    """With one to three options per episode and slices of eight, the meta-controller's sequences are mostly padding."""
    torch.manual_seed(0)
    env = small_env(8)
    algorithm = build("v2", env, settings=tiny_settings(slice_len=8, batch_size=16))
    meta = algorithm.learners["meta"]
    for batch in collect(algorithm, env, 20, batches=2):
        meta.store(batch)
    sample = meta.sample()
    real = sample["collector", "mask"]
    assert real.sum(-1).max() <= 5
    final = (sample["next", "done"] & ~sample["next", "terminated"]).squeeze(-1)
    starts, options = sample["is_init"][:, 0, 0], real & ~final
    result = meta.loss(sample)
    assert result["loss"] > 0 and not final[:, 0].any()
    assert result["trained_steps"] >= options[starts].sum() > 0


@pytest.mark.parametrize("name", ["v2", "v3"])
def test_two_algorithms_share_nothing(name):
    first, second = (build(name, small_env(2)) for _ in range(2))
    ids = [{id(t) for t in [*a.policy.parameters(), *a.policy.buffers()]} for a in (first, second)]
    assert not ids[0] & ids[1]
    for one, other in zip(first.learners.values(), second.learners.values(), strict=True):
        assert one.buffer is not other.buffer


V2_STATES = ("sub_hidden", "meta_hidden")
V3_STATES = ("memory_hidden", "memory_cell", "previous_action", "repeated_action")


@pytest.mark.parametrize(("name", "states"), [("v2", V2_STATES), ("v3", V3_STATES)])
def test_a_collector_carries_options_and_states_from_batch_to_batch(name, states):
    torch.manual_seed(0)
    env = small_env(4)
    collector = make_collector(build(name, env), env, 3)
    first, second = (batch.clone() for batch, _ in zip(collector, range(2), strict=False))
    collector.shutdown()
    going_on = ~first["next", "done"][:, -1].squeeze(-1)
    assert going_on.any()
    for key in (*states, "option_return", "option_steps", "active_subgoal", "option_init"):
        assert (second[key][:, 0] == first["next", key][:, -1])[going_on].all(), key


FLAT = [{"sampling": sampling} for sampling in ("steps", "episodes", "episode_starts", "whole_episodes")]
PRIORITISED = [{**settings, "priority_exponent": 0.9} for settings in FLAT if settings["sampling"] != "episodes"]
STARTS = [settings for settings in FLAT + PRIORITISED if settings["sampling"] in FROM_STARTS]
STORED = [{**settings, "stored_state": True} for settings in FLAT + PRIORITISED if settings not in STARTS]
OPTIONS = [settings for settings in FLAT + PRIORITISED + STORED if settings["sampling"] != "episode_starts"]


@cache
def played(make):
    """Batches collected by an algorithm that ``make`` builds."""
    torch.manual_seed(0)
    env = small_env(8)
    return collect(make(env, NETWORKS["compact"]), env, 10, batches=3)


class TestSequences:
    """Every way to draw sequences, with every level that supports it."""

    @pytest.mark.parametrize("settings", FLAT + PRIORITISED + STORED, ids=str)
    @pytest.mark.parametrize(("make", "level"), [(make_drqn, "learner"), (make_hdrqn, "sub")], ids=["drqn", "v2"])
    def test_sequences_of_steps_are_drawn_by_every_sampling(self, make, level, settings):
        self.check(make, level, settings)

    @pytest.mark.parametrize("settings", OPTIONS, ids=str)
    def test_sequences_of_options_are_drawn_by_every_sampling(self, settings):
        self.check(make_hdrqn, "meta", settings)

    @pytest.mark.parametrize("settings", STARTS + STORED, ids=str)
    def test_sequences_of_v3_are_drawn_by_every_sampling(self, settings):
        self.check(make_v3, "learner", settings)

    def check(self, make, level, settings):
        settings, env = tiny_settings(batch_size=16, **settings), small_env(8)
        algorithm = make(env, NETWORKS["compact"], **{level: settings})
        learner = algorithm.learners["meta" if level == "meta" else next(iter(algorithm.learners))]
        for batch in played(make):
            learner.store(batch)
        metrics = learner.learn()
        assert metrics["trained_steps"] > 0 and all(torch.isfinite(value) for value in metrics.values())
        sample = learner.sample()
        assert sample["is_init"][:, 0].all() if settings.sampling in FROM_STARTS else len(sample) == 16
        assert ("priority_weight" in sample) == (settings.priority_exponent is not None)


STATES = {
    ("drqn", "flat"): ["sub_hidden", "sub_cell"],
    ("v1", "sub"): ["sub_hidden", "sub_cell"],
    ("v1", "meta"): ["meta_hidden", "meta_cell"],
    ("v2", "sub"): ["sub_hidden", "sub_cell"],
    ("v2", "meta"): ["meta_hidden", "meta_cell"],
    ("v3", "joint"): ["memory_hidden", "memory_cell"],
}


class TestStoredStates:
    @pytest.mark.parametrize(("name", "level"), STATES)
    @pytest.mark.parametrize("stored_state", [False, True])
    def test_states_are_stored_and_used_only_with_stored_state(self, name, level, stored_state):
        torch.manual_seed(0)
        env = small_env(8)
        options = {} if name == "drqn" else {"max_option_steps": 3}
        settings = tiny_settings(stored_state=stored_state, batch_size=64, slice_len=2, burn_in=0.0)
        algorithm = build(name, env, NETWORKS["compact"], settings=settings, **options)
        learner = algorithm.learners[level]
        learner.store(collect(algorithm, env, 30)[0])
        sample = learner.sample()
        for key in STATES[name, level]:
            assert (key in sample) == stored_state
        before = learner.update(sample.clone())
        assert all(torch.isfinite(value) for value in before.values())
        if stored_state:
            before = learner.loss(sample)["loss"]
            sample[STATES[name, level][0]][:, 0] += 1.0
            assert learner.loss(sample)["loss"] != before

    @pytest.mark.parametrize("name", ["dqn", "hdqn"])
    def test_stored_state_is_refused_for_networks_without_memory(self, name):
        with pytest.raises(ValueError, match="stored_state must be False for networks without memory, got True; "):
            build(name, small_env(2), settings=tiny_settings(stored_state=True))


class TestV3:
    def make(self, env=None, *, learner=None, **options):
        torch.manual_seed(0)
        settings = tiny_settings(**({"sampling": "episode_starts", "batch_size": 16} | (learner or {})))
        return make_v3(env or small_env(8), NETWORKS["compact"], learner=settings, **options)

    def steps(self, **options):
        env = small_env(8)
        algorithm = self.make(env, **options)
        return algorithm, collect(algorithm, env, 40)[0]

    def test_one_update_changes_every_part_and_the_target_network(self):
        algorithm, batch = self.steps(learner={"tau": 0.25, "learning_rate": 0.1, "max_grad_norm": None})
        learner, network = algorithm.learners["joint"], algorithm.policy.network
        learner.store(batch)
        before = {name: p.detach().clone() for name, p in network.named_parameters()}
        metrics = learner.learn()
        target = learner.loss.target_policy_params["network"].flatten_keys(".")
        for name, parameter in network.named_parameters():
            moved = (parameter - before[name]).abs().max().item()
            assert moved > 0 or name.startswith("memory.bias_hh"), name
            torch.testing.assert_close(target[name], before[name].lerp(parameter.detach(), 0.25), msg=name)
        assert not any(value.requires_grad for value in metrics.values())
        assert set(metrics) == set(learner.loss.out_keys) - {"priority"}

    def test_a_sequence_has_one_more_step_than_are_trained(self):
        algorithm, batch = self.steps(learner={"slice_len": 5, "batch_size": 3})
        learner = algorithm.learners["joint"]
        learner.store(batch)
        assert learner.sample().shape == (3, 6)

    def test_no_next_observation_and_no_state_is_stored(self):
        """No observation is stored twice."""
        algorithm, batch = self.steps()
        stored = algorithm.learners["joint"].extract(batch)
        ends = {("next", key) for key in ("done", "terminated", "truncated")} | {("collector", "traj_ids")}
        assert set(stored.keys(True, True)) == ends | {
            "observation",
            "previous_action",
            "action",
            "is_init",
            "option_init",
            "subgoal_mask",
            ("next", "attained"),
            ("next", "hazard"),
            ("next", "extrinsic_reward"),
            ("next", "active_subgoal"),
        }
        assert all((stored[key] == batch[key]).all() for key in stored.keys(True, True))

    @pytest.mark.parametrize(
        ("name", "value", "read"),
        [
            ("sub_gamma", 0.5, lambda loss: loss.rules[0].gamma),
            ("meta_gamma", 0.5, lambda loss: loss.rules[1].gamma),
            ("trace_decay", 0.25, lambda loss: loss.targets.trace_decay),
            ("all_subgoals", False, lambda loss: loss.targets.all_subgoals),
            ("intra_option", False, lambda loss: loss.targets.intra_option),
            ("wrong_subgoal_reward", -0.25, lambda loss: loss.rules[0].rewards.wrong_subgoal),
            ("hazard_reward", -0.75, lambda loss: loss.rules[0].rewards.hazard),
            ("max_meta_target", 1.5, lambda loss: loss.rules[1].largest_return),
        ],
    )
    def test_options_reach_the_loss(self, name, value, read):
        default, changed = (self.make(**options).learners["joint"].loss for options in ({}, {name: value}))
        assert read(default) != read(changed) == value

    def test_double_reaches_the_loss(self):
        for double in (True, False):
            assert self.make(learner={"double": double}).learners["joint"].loss.double_q == double

    def test_options_reach_the_network(self):
        algorithm = self.make(memory_size=9, head_size=7, joint=False)
        network = algorithm.policy.network
        assert (network.hidden_size, network.sub_head[0].out_features, network.joint) == (9, 7, False)
        assert self.make().policy.network.joint
        assert (network.num_actions, network.num_subgoals) == (4, (2,))

    def test_rewards_and_discount_reach_the_option_book(self):
        _, batch = self.steps(wrong_subgoal_reward=-0.25, hazard_reward=-0.75, meta_gamma=0.5)
        assert batch["next", "intrinsic_reward"].unique().tolist() == [-0.75, -0.25, 0.0, 1.0]
        steps, option_return = batch["next", "option_steps"], batch["next", "option_return"]
        late = batch["next", "subgoal_reached"] & (steps > 1)
        assert (option_return == 0.5 ** (steps - 1))[late].any()  # a goal in order

    def test_max_option_steps_limits_options(self):
        for limit in (None, 3):
            _, batch = self.steps(max_option_steps=limit)
            assert batch["next", "option_steps"].max() == (limit or 7)

    def test_schedules_reach_their_level(self):
        sub, meta = RepeatingEpsilonGreedy(0.5, 0.5), EpsilonGreedy(0.25, 0.25)
        algorithm = self.make(sub_exploration=sub, meta_exploration=meta)
        assert algorithm.policy.sub_exploration is algorithm.explorations["sub"] is sub
        assert algorithm.policy.meta_exploration is algorithm.explorations["meta"] is meta
        default = self.make()
        assert isinstance(default.explorations["sub"], RepeatingEpsilonGreedy)
        assert not isinstance(default.explorations["meta"], RepeatingEpsilonGreedy)
        assert default.explorations["sub"] is not self.make().explorations["sub"]

    def test_exploration_by_single_steps_carries_no_entry(self):
        _, batch = self.steps(sub_exploration=EpsilonGreedy(0.5, 0.5))
        assert "repeated_action" not in batch and "repeated_action" not in batch["next"]

    @pytest.mark.parametrize("sampling", ["steps", "episodes"])
    def test_sampling_in_mid_episode_is_refused(self, sampling):
        with pytest.raises(
            ValueError,
            match=rf"learner\.sampling must be one of \(.*\) for v3 without stored_state, got '{sampling}': ",
        ):
            self.make(learner={"sampling": sampling})

    def test_whole_episodes_and_continuing_sequences_give_the_same_loss(self):
        """Continuing sequences, cut off after their first episode, equal those that are padded there."""
        algorithm, batch = self.steps(prediction_steps=0, learner={"slice_len": 7, "batch_size": 64})
        learner, losses = algorithm.learners["joint"], {}
        for sampling in ("episode_starts", "whole_episodes"):
            settings = {"slice_len": 8, "batch_size": 512, "num_envs": 8, "sampling": sampling}
            buffer = make_sequence_buffer(2_000, **settings)
            buffer.extend(learner.extract(batch))
            sample = sample_sequences(buffer)
            if sampling == "episode_starts":
                sample["collector", "mask"] = sample["is_init"].squeeze(-1).cumsum(-1) == 1
            rows = {row["collector", "traj_ids"][0, 0].item(): row for row in sample.split(1)}
            for traj, row in sorted(rows.items())[:40]:
                losses.setdefault(traj, {})[sampling] = learner.loss(row)["loss"]
        both = [tuple(found.values()) for found in losses.values() if len(found) == 2]
        assert len(both) > 20 and sum(first > 0 for first, _ in both) > 20
        for first, second in both:
            torch.testing.assert_close(first, second)

    def test_a_meta_level_that_only_reads_the_memory_has_its_own_optimiser(self):
        learner = self.make(joint=False, meta_learning_rate=1e-4, learner={"learning_rate": 1e-3}).learners["joint"]
        rest, head = learner.optimizer.param_groups
        assert (rest["lr"], head["lr"]) == pytest.approx((1e-3, 1e-4))
        assert {id(p) for p in head["params"]} == {id(p) for p in learner.network.network.meta_head.parameters()}
        with pytest.raises(ValueError, match=r"meta_learning_rate must be None with joint=True, got 0\.1"):
            self.make(meta_learning_rate=0.1)

    def test_learner_settings_reach_the_loss(self):
        changes = {"burn_in": 0.25, "loss_function": "smooth_l1"}
        loss = self.make(learner=changes).learners["joint"].loss
        assert {name: getattr(loss, name) for name in changes} == changes
        loss = self.make(learner={"burn_in": 0.0, "train_exact_states": False}).learners["joint"].loss
        assert not loss.train_exact_states

    def test_max_target_of_the_learner_is_refused_for_v3(self):
        with pytest.raises(ValueError, match=r"max_target must be None for v3, got 1.0; .* by max_meta_target"):
            self.make(learner={"max_target": 1.0})

    @pytest.mark.parametrize("settings", [{"trace_decay": 0.5}, {"n_step": 2}], ids=str)
    def test_trace_decay_and_n_step_of_the_learner_are_refused_for_v3(self, settings):
        with pytest.raises(
            ValueError, match=r"trace_decay and n_step must be left at 0 and 1 for v3, got .*; use v3's own"
        ):
            self.make(learner=settings)

    def test_the_default_slice_len_is_the_length_of_an_episode(self):
        assert V3_LEARNER.sampling == "episode_starts"
        algorithm = make_v3(small_env(2), NETWORKS["compact"])
        assert algorithm.learners["joint"].settings == replace(V3_LEARNER, slice_len=7)  # the steps of an episode

    def test_a_restored_learner_continues_identically(self):
        algorithm, batch = self.steps()
        first, second = algorithm.learners["joint"], self.make().learners["joint"]
        first.store(batch[:, :20])
        second.store(batch[:, 20:])
        for learner in (first, second):
            learner.learn()
        second.load_state_dict(deepcopy(first.state_dict()))  # torch's optimiser keeps what it is given
        for learner in (first, second):
            torch.manual_seed(1)
            learner.store(batch[:, 20:])
            for _ in range(2):
                learner.learn()
        assert parameter_distance(first.loss.policy_params.data, second.loss.policy_params.data) == 0
        assert parameter_distance(first.loss.target_policy_params, second.loss.target_policy_params) == 0


class TestRepeatedActions:
    """Temporally extended epsilon-greedy works with every algorithm."""

    @pytest.mark.parametrize("name", ["drqn", "dqn", "v1", "v2", "hdqn"])
    def test_random_stretches_span_steps_but_not_episodes(self, name):
        torch.manual_seed(0)
        env = small_env(32, max_steps=20, num_goals=2)
        always = RepeatingEpsilonGreedy(1.0, 1.0, exponent=0.01, max_repeats=10)
        place = "exploration" if name in ("drqn", "dqn") else "sub_exploration"
        algorithm = build(name, env, **{place: always})
        steps = collect(algorithm, env, 60)[0]
        left, action = steps["repeated_action"][..., 1], steps["action"]
        assert not left[steps["is_init"].squeeze(-1)].any()
        starts = steps["is_init" if name in ("drqn", "dqn") else "option_init"].squeeze(-1)
        goes_on = (left[:, 1:] > 0) & ~starts[:, 1:]
        assert goes_on.float().mean() > 0.6
        assert (action[:, 1:] == action[:, :-1])[goes_on].all()
        for learner in algorithm.learners.values():
            learner.store(steps)
        assert torch.isfinite(learner.learn()["loss"])

    @pytest.mark.parametrize("name", ["v1", "v2", "hdqn", "v3"])
    def test_random_stretches_do_not_span_options(self, name):
        """Only every second option explores here; its random stretch must not continue in the next one."""
        torch.manual_seed(0)
        env = small_env(16, max_steps=30, num_goals=2)
        exploration = SuccessEpsilonGreedy(1.0, 0.0, max_repeats=15, exponent=0.01)
        algorithm = build(name, env, sub_exploration=exploration, max_option_steps=3)
        exploration.success.rates.copy_(torch.tensor([0.0, 1.0]))  # the second subgoal needs no exploring
        greedy = []
        exploration.register_forward_pre_hook(lambda _, inputs: greedy.append(inputs[0].argmax(-1)))
        with set_exploration_type(ExplorationType.RANDOM):
            steps = algorithm.transform(env).rollout(40, algorithm.policy, break_when_any_done=False)
        mastered = steps["subgoal"] == 1
        taken, best = steps["action"], torch.stack(greedy, 1)
        assert (taken == best)[mastered].all() and not (taken == best)[~mastered].all()
        assert not steps["next", "repeated_action"][mastered][:, 1].any()
        starts = steps["option_init"].squeeze(-1)
        assert (steps["repeated_action"][..., 1] > 0)[starts & mastered].any()  # there was something to drop

    @pytest.mark.parametrize("name", ["v1", "v2", "hdqn", "v3"])
    def test_subgoals_are_not_repeated(self, name):
        with pytest.raises(ValueError, match="where subgoals are chosen, got RepeatingEpsilonGreedy: "):
            build(name, small_env(), meta_exploration=RepeatingEpsilonGreedy())

    @pytest.mark.parametrize("name", ["dqn", "drqn", "v1", "v2", "hdqn", "v3"])
    def test_success_epsilon_greedy_is_refused_at_the_top_level(self, name):
        place = "exploration" if name in ("drqn", "dqn") else "meta_exploration"
        with pytest.raises(ValueError, match="not be a SuccessEpsilonGreedy where no subgoal is pursued"):
            build(name, small_env(), **{place: SuccessEpsilonGreedy()})

    def test_a_greedy_policy_does_not_repeat_actions(self):
        env = small_env(4)
        algorithm = build("v2", env, sub_exploration=RepeatingEpsilonGreedy(1.0, 1.0))
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            steps = algorithm.transform(env).rollout(6, algorithm.policy, break_when_any_done=False)
        assert not steps["repeated_action"].any()


def test_targets_are_bounded_by_default_and_unbounded_as_in_paper():
    found = {}
    with initialize_config_dir(str(configuration.CONF), version_base="1.3"):
        for experiment in (None, "as_in_paper"):
            chosen = [] if experiment is None else [f"experiment={experiment}"]
            config = compose("config", overrides=["algo=v2", "env.num_envs=2", "env.num_goals=3", *chosen])
            learners = build_algorithm(configuration.resolved(config))[1].learners
            found[experiment] = [learners[level].loss.max_target for level in ("sub", "meta")]
    assert found == {None: [1.0, 3.0], "as_in_paper": [math.inf, math.inf]}
