"""The files of conf/: what they compose to can be built."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra._internal.utils import _locate
from omegaconf import OmegaConf
from run_folders import CONF

from hdrqn_torchrl.cli.configuration import resolved
from hdrqn_torchrl.runs.settings.arguments import _taken_by
from hdrqn_torchrl.runs.settings.building import build_algorithm
from hdrqn_torchrl.runs.settings.run_settings import check


@pytest.mark.parametrize("name", ["drqn", "v1", "v2", "v3"])
def test_all_learners_have_one_precision(name):
    small = ["env.num_envs=4", "network.hidden_size=8", "network.widths=[8]"]
    with initialize_config_dir(CONF, version_base="1.3"):
        config = compose("config", overrides=[f"algo={name}", "precision=fp32", *small])
        wrong = compose("config", overrides=[f"algo={name}", "precision=fp16", *small])
    _, algorithm = build_algorithm(resolved(config))
    assert {learner.settings.precision for learner in algorithm.learners.values()} == {"fp32"}
    with pytest.raises(ValueError, match=r"precision must be one of 'fp32', 'bf16', 'auto', got 'fp16'; "):
        build_algorithm(resolved(wrong))


@pytest.mark.parametrize(
    ("chosen", "penalty"),
    [
        (["env=gridworld", "algo=v3"], -0.5),  # where goals have an order
        (["env=four_rooms", "algo=v3"], -0.5),
        (["env=nine_rooms", "algo=v3"], -0.5),
        (["variant=v3"], -0.5),
        (["variant=v3_free_passage"], 0.0),
        (["env=gridworld", "algo=v3", "algo.wrong_subgoal_reward=-0.25"], -0.25),
        (["env=montezuma", "algo=v3"], 0.0),
        (["env=gridworld", "algo=v2"], 0.0),
    ],
    ids=str,
)
def test_the_penalty_for_a_wrong_subgoal_follows_the_task(chosen, penalty):
    with initialize_config_dir(CONF, version_base="1.3"):
        assert compose("config", overrides=chosen).algo.wrong_subgoal_reward == penalty


GIVEN_BY_TRAIN = {"env", "architecture", "total_frames", "seed", "device", "repeatable_subgoals"}
LEFT_OUT = {
    "hdrqn_torchrl.envs.MultiGoalGridEnv": {"places"},  # as the layout has it; four_rooms asks
    "hdrqn_torchrl.envs.make_montezuma": {"keep_pixels"},  # for those who watch
    "hdrqn_torchrl.learning.LearnerSettings": {"max_target", "trace_decay", "n_step"},  # v3 has its own, or none
}


@pytest.mark.parametrize(
    "chosen",
    [
        *([f"algo={name}"] for name in ("dqn", "drqn", "hdqn", "v1", "v2", "v3")),
        *([f"env={name}"] for name in ("four_rooms", "nine_rooms", "minigrid", "gym")),
        *(["env=montezuma", f"algo={name}"] for name in ("v2", "v3")),
        ["network=paper"],
    ],
    ids=str,
)
def test_every_argument_of_a_builder_stands_in_its_file(chosen):
    def check(node):
        if "_target_" in node:
            target = node["_target_"]
            missing = set(_taken_by(_locate(target))) - set(node) - GIVEN_BY_TRAIN
            assert missing <= LEFT_OUT.get(target, set()), target
        for value in node.values():
            if isinstance(value, dict):
                check(value)

    with initialize_config_dir(CONF, version_base="1.3"):
        config = OmegaConf.to_container(compose("config", overrides=chosen))
    for group in ("env", "algo", "network"):
        check(config[group])


VARIANTS = sorted(path.stem for path in (Path(CONF) / "variant").glob("*.yaml"))


class TestVariants:
    @pytest.mark.parametrize("name", VARIANTS)
    def test_each_variant_can_be_built_and_differs_from_its_algorithm(self, name):
        small = ["env.num_envs=4", "network.hidden_size=8", "network.widths=[8]"]
        with initialize_config_dir(CONF, version_base="1.3"):
            config = compose("config", overrides=[f"variant={name}", *small])
            plain = compose("config", overrides=[f"algo={name.split('_')[0]}", *small])
        check(resolved(config))
        build_algorithm(resolved(config))
        assert ((config.algo, config.env) != (plain.algo, plain.env)) == ("_" in name)

    def test_each_variant_belongs_to_an_experiment(self):
        used = set()
        for name in ("ablation", "authors_choices"):
            sweep = OmegaConf.load(Path(CONF) / "experiment" / f"{name}.yaml").hydra.sweeper.params
            used |= set(sweep.variant.split(","))
        assert sorted(used) == VARIANTS
