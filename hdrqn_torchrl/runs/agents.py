"""Trained agents read back from their run folders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torchrl.envs import EnvBase

from hdrqn_torchrl.algorithms import Algorithm
from hdrqn_torchrl.envs.specs import interface_differences
from hdrqn_torchrl.runs.facts import warn_of_other_names
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.weights import load_policy
from hdrqn_torchrl.runs.settings.arguments import SettingsError, shown
from hdrqn_torchrl.runs.settings.building import build_algorithm, build_env
from hdrqn_torchrl.runs.settings.reading import read_config
from hdrqn_torchrl.runs.settings.run_settings import RunSettings


@dataclass(frozen=True)
class Agent:
    """A trained agent on its task."""

    config: RunSettings
    """Those of its run, with the changes that were asked for."""
    env: EnvBase
    """Transformed environment with batch size ``[num_envs]``."""
    algorithm: Algorithm
    frames: int | None = None
    """Environment frames that its weights were trained for; ``None``: weights without a checkpoint do not say."""


def load_agent(
    run: str | Path,
    *,
    checkpoint: str = "best",
    num_envs: int = 1,
    env_changes: Mapping[str, Any] | None = None,
    allowed_targets: Sequence[str] = (),
) -> Agent:
    """Builds a run's agent on its task and loads its weights. Nothing in the folder can run code.

    Args:
        run: run folder.
        checkpoint: ``"best"``, ``"last"``, or the path of a checkpoint or weights file.
        num_envs: number of worlds of the environment.
        env_changes: settings of the environment that are to differ from the run's (``{"layout": "four_rooms"}``); what
            the agent sees and does must keep its shape.
        allowed_targets: builders of your own that the run's settings may name (``["my_package.MyEnv"]``).

    Returns:
        The agent on the CPU: its environment, with the transforms of its algorithm, and its algorithm.

    Raises:
        SettingsError: if the folder is not a run, names something that may not be built, or its weights do not fit. It
            is a ``ValueError``.

    Examples:
        >>> agent = load_agent("outputs/gridworld-v2/2026-11-22_16-04-11-seed0", num_envs=10)  # doctest: +SKIP
        >>> rollout = agent.env.rollout(50, agent.algorithm.policy, break_when_any_done=False)  # doctest: +SKIP
    """
    folder = Path(run)
    own = read_config(folder)
    changes = {**own.evaluation.env, **(env_changes or {})}
    for key in changes:
        if key.startswith("_") or key not in own.env:
            raise SettingsError(f"env.KEY must be one of {sorted(set(own.env) - {'_target_'})}, got {key}.")
    config = replace(own, env=own.env | changes)
    env, algorithm = build_algorithm(config, {"num_envs": num_envs, "device": "cpu"}, allowed_targets)
    try:
        frames = load_policy(algorithm.policy, folder / layout.CHECKPOINTS, checkpoint)
    except ValueError as error:
        if changes:
            refuse_other_interface(build_env(own, {"num_envs": 1, "device": "cpu"}, allowed_targets), env, changes)
        raise SettingsError(str(error)) from error
    warn_of_other_names(folder, env)
    return Agent(config, algorithm.transform(env), algorithm, frames)


def refuse_other_interface(env: EnvBase, changed: EnvBase, changes: Mapping[str, Any]) -> None:
    """Says why an agent's networks don't fit a changed task, if that is the reason."""
    if found := interface_differences(env, changed):
        given = " ".join(f"env.{key}={shown(value)}" for key, value in changes.items())
        raise SettingsError(
            f"{given} must not change what the agent's networks see or choose from, but {found}; train an "
            "agent for that task."
        )
