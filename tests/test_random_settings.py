"""Random settings either train, without NaN, or are refused with key, rule and value, without traceback."""

import csv
import json
import math
import random
from copy import deepcopy
from functools import cache

import pytest
from hydra import compose, initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict
from programs import CONF

from hdrqn_torchrl.cli import train, training
from hdrqn_torchrl.cli.configuration import RunError
from hdrqn_torchrl.cli.resuming import Plan
from hdrqn_torchrl.runs.settings.arguments import SettingsError

VALUES = (
    "0", "1", "2", "3", "-1", "7", "1000", "0.5", "1.5", "-0.5", "1e3", "inf", "nan", "null", "true", "abc", "''",
    "[]", "[1]", "[x]", "{}", "{a:1}",
)  # fmt: skip
ELSEWHERE = ("output_root", "resume", "resume_override", "allowed_targets", "device", "threads", "seed", "logger")
QUICK = [
    "device=cpu", "env.num_envs=4", "env.max_steps=6", "total_frames=64", "log_frames=16", "evaluation.num_envs=4",
    "evaluation.episodes=4", "evaluation.interval_frames=32", "evaluation.final_episodes=4", "network.hidden_size=8",
    "logger=csv", "evaluation.ceilings=false",
]  # fmt: skip
LEARNERS = {"v3": ["learner"], "dqn": ["learner"], "drqn": ["learner"]}


@cache
def composed(env, algo, network):
    """The settings of a small training, with Hydra's own."""
    quick = [*QUICK, f"env={env}", f"algo={algo}", f"network={network}"]
    for level in LEARNERS.get(algo, ["sub", "meta"]):
        quick += [f"algo.{level}.{each}" for each in ("batch_size=4", "warmup_frames=8", "frames_per_update=16")]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=quick, return_hydra_config=True)


def leaves(node, path=""):
    """Full names of all settings, including those of parts that have settings themselves."""
    for key in node:
        name = f"{path}{key}"
        if name.partition(".")[0] in (*ELSEWHERE, "hydra"):
            continue
        yield name
        child = node._get_node(key)
        if isinstance(child, DictConfig) and not child._is_none():
            yield from leaves(child, f"{name}.")


WORDS = {
    "sampling": ("steps", "episodes", "episode_starts", "whole_episodes"), "loss_function": ("l2", "smooth_l1"),
    "precision": ("fp32", "bf16", "auto"), "version": ("v1", "v2"), "meta_input": ("hidden", "cell", "both"),
    "meta_input_time": ("after_last_decision", "after_last_observation"), "obstacle": ("stay", "teleport"),
    "layout": ("open", "four_rooms"), "max_target": (1.0, 2.0), "priority_exponent": (0.9,), "view": (3, 5, 7, "null"),
    "max_option_steps": (1, 3), "refresh_hidden_steps": (7,), "max_steps": (4, 12), "num_envs": (1, 2, 5),
    "phase_one": ("{_target_: hdrqn_torchrl.learning.PhaseOne, max_frames: 20}",), "slice_len": (1, 2, 3),
}  # fmt: skip


def plausible(config, key, dice):
    """A plausible value."""
    value = OmegaConf.select(config, key)
    if (name := key.rpartition(".")[2]) in WORDS:
        return dice.choice(WORDS[name])
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return dice.choice((1, 2, 3, 2 * value, value // 2))
    return dice.choice((0.0, 0.5, 1.0, value / 2)) if isinstance(value, float) else "null"


def draw(number):
    """The overrides of configuration ``number``, and what it is composed from."""
    dice = random.Random(number)
    parts = (
        dice.choice(("gridworld", "four_rooms")),
        dice.choice(("dqn", "drqn", "hdqn", "v1", "v2", "v3")),
        dice.choice(("compact", "paper")) if dice.random() < 0.2 else "compact",
    )
    base = composed(*parts)
    keys = dice.sample(sorted(set(leaves(base))), dice.choice((1, 2, 3)))
    if number % 2:
        return parts, [f"{key}={plausible(base, key, dice)}" for key in keys if not key.endswith("_target_")]
    overrides = [f"{key}={dice.choice(VALUES)}" for key in keys]
    if dice.random() < 0.1:
        overrides.append(f"++evaluation.env={{num_goals: {dice.choice((1, 2, 3, 'x'))}}}")
    if dice.random() < 0.1:
        overrides.append(f"logger.loggers={dice.choice(VALUES)}")
    return parts, overrides


def configure(parts, overrides):
    """Composes as Hydra does, but for the files, which are read once."""
    config = deepcopy(composed(*parts))
    with open_dict(config.hydra):
        config.hydra.mode = "RUN"
    ConfigLoaderImpl._apply_overrides_to_config(OverridesParser.create().parse_overrides(overrides), config)
    HydraConfig.instance().set_config(config)
    with open_dict(config):
        del config["hydra"]
    return config


def refused(number, folder, run):
    """The message of a configuration that is refused; ``None`` if it is not. ``run`` does the work."""
    parts, overrides = draw(number) if isinstance(number, int) else number
    try:
        config = configure(parts, overrides)
        settings = train.resolved(config)
        train.check(settings)
        plan = Plan(folder, settings, {}, resumed=False)
        folder.mkdir()
        with training.in_words(plan):
            run(plan)
    except (SettingsError, RunError, HydraException) as error:
        return str(error)
    except Exception as error:
        raise AssertionError(f"{number}: {parts} {overrides}") from error
    return None


def check_message(number, told):
    """The message names a setting that was given (or its parent or child), and says more than a Python type."""
    _, overrides = draw(number)
    keys = [override.lstrip("+").partition("=")[0] for override in overrides]
    named = [key for key in keys if key in told or key.rpartition(".")[0] in told or "logger.loggers" in told]
    assert named and "Traceback" not in told, (number, overrides, told)
    assert " must " in told or "could not" in told.lower() or "Error merging override" in told, (number, told)


def check_trains(number, folder):
    """There are at least two rows, a ceiling only if it was asked for, and all cells are finite numbers or empty."""
    told = refused(number, folder, train.train)
    if told is not None:
        check_message(number, told)
        return
    with (folder / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    ceiling = json.loads((folder / "summary.json").read_text())["ceiling"]
    plays = configure(*draw(number)).evaluation.ceilings
    assert len(rows) > 1 and plays == (ceiling is not None) == ("greedy/ceiling" in rows[0])
    cells = [(name, cell) for row in rows for name, cell in row.items() if cell]
    assert [(name, cell) for name, cell in cells if not math.isfinite(float(cell))] == [], draw(number)


def check_builds(number, folder):
    if (told := refused(number, folder, training.build_run)) is not None:
        check_message(number, told)
    return told


@pytest.mark.parametrize(
    "first", [0, 50, *(pytest.param(first, marks=pytest.mark.slow) for first in range(100, 300, 50))]
)
def test_random_configurations_are_built_or_refused_with_a_clear_error(first, tmp_path):
    told = [check_builds(number, tmp_path / str(number)) for number in range(first, first + 50)]
    assert 10 < told.count(None) < 40


@pytest.mark.parametrize("number", range(1, 101, 10))
def test_ten_random_configurations_train(number, tmp_path, monkeypatch):
    monkeypatch.setattr("hdrqn_torchrl.analysis.plotting.plot_run", lambda _, path, **settings: path.touch())
    check_trains(number, tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("first", range(1_000, 2_000, 50))
def test_many_random_configurations_train_or_are_refused_with_a_clear_error(first, tmp_path, monkeypatch):
    monkeypatch.setattr("hdrqn_torchrl.analysis.plotting.plot_run", lambda _, path, **settings: path.touch())
    for number in range(first, first + 50):
        check_trains(number, tmp_path / str(number))


@pytest.mark.parametrize(
    ("override", "rule"),
    [
        ("algo.hazard_reward=[1]", "algo.hazard_reward must be a finite number, got [1]"),
        ("logger.loggers=5", "logger.loggers must be a list, got 5"),
        ("logger.loggers=null", "logger.loggers must be a list, got null"),
        ("algo.sub.batch_size=1.5", "algo.sub.batch_size must be an integer, got 1.5"),
        ("algo.max_option_steps=[1]", "algo.max_option_steps must be an integer or null, got [1]"),
        ("checkpoint.interval_frames=[1]", "checkpoint.interval_frames"),
        ("++evaluation.env={num_goals: 3}", "evaluation.env must not change what the agent sees or does"),
        ("++evaluation.env={num_goals: x}", "evaluation.env.num_goals must be an integer, got 'x'"),
        ("env.view=abc", "env.view must be an integer or null, got 'abc'"),
        ("network.widths=[x]", "network.widths must be a list of integers, got ['x']"),
        ("algo.meta.burn_in=1.5", "algo.meta.burn_in must be in [0, 1), got 1.5"),
        ("algo.sub.tau=nan", "algo.sub.tau must be a number, got nan"),
    ],
)
def test_settings_that_used_to_end_in_a_traceback_are_refused_by_name(override, rule, tmp_path):
    parts = ("gridworld", "v2", "compact")
    assert rule in refused((parts, [override]), tmp_path / "run", training.build_run)
