"""Weights of one run as the beginning of another: ``init_from`` of train.py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.checkpoint import CheckpointError

from hdrqn_torchrl.algorithms import Algorithm
from hdrqn_torchrl.discovery import Discovery
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints
from hdrqn_torchrl.runs.persistence.weights import read_weights

Weights = dict[str, Tensor]
_SHOWN = 3  # weights that a message names


def find_weights(place: Path, which: str = "best") -> Path:
    """The checkpoint or file that holds the weights that a user means.

    Args:
        place: a run folder, that of an agent of a zoo, a checkpoint, or a file of
            :func:`~hdrqn_torchrl.runs.persistence.weights.save_weights`.
        which: ``"best"`` or ``"last"`` of a run folder's checkpoints.

    Returns:
        A checkpoint or a file.

    Raises:
        ValueError: if there is none.
    """
    try:
        if place.is_file() or layout.is_checkpoint(place):
            return place
        checkpoints = Checkpoints(place / layout.CHECKPOINTS)
        path = checkpoints.best() if which == "best" else checkpoints.newest()
        if path is None and (place / layout.WEIGHTS).is_file():  # an agent of a zoo
            return place / layout.WEIGHTS
    except (CheckpointError, OSError) as error:
        raise ValueError(f"init_from can't be read: {error}") from error
    if path is None:
        raise ValueError(f"init_from must be a run folder, a checkpoint or a weights file, got {place}.")
    return path


def load_weights_of(path: Path) -> Weights:
    """Weights of the policy in a checkpoint or a file; neither can run code.

    Raises:
        ValueError: if it is damaged, or something else.
    """
    if path.is_file():
        return read_weights(path)
    policy = _Captured()
    try:
        Checkpoints(path.parent).load({"policy": policy}, path)
    except CheckpointError as error:
        raise ValueError(f"init_from can't be read: {error}") from error
    if not isinstance(policy.state, dict) or not all(isinstance(value, Tensor) for value in policy.state.values()):
        raise ValueError(f"init_from must hold weights, got something else in {path}; it is damaged.")
    return policy.state


class _Captured:
    """A component that keeps what it is to load."""

    state: dict[str, Any]

    def state_dict(self) -> dict[str, Any]:
        return self.state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.state = state


@torch.no_grad()
def start_from(algorithm: Algorithm, weights: Weights) -> None:
    """Copies weights into an agent's networks and target networks, and the subgoals that it has found, if it finds
    them itself; exploration, counters and memories stay new.

    Args:
        algorithm: an agent that has not been trained.
        weights: of the policy of an agent whose networks have the same parameters.

    Raises:
        ValueError: if they have others, naming the first of them; nothing is copied then.
    """
    wanted = {name: each for name, each in algorithm.policy.state_dict().items() if not _is_of_exploration(name)}
    found = {name: value for name, value in weights.items() if name in wanted or not _is_of_exploration(name)}
    differing = [
        f"{name} is {_shape(found.get(name))} there and {_shape(wanted.get(name))} here"
        for name in {**wanted, **found}
        if _shape(found.get(name)) != _shape(wanted.get(name))
    ]
    if differing:
        more = f" and {len(differing) - _SHOWN} more" if len(differing) > _SHOWN else ""
        raise ValueError(
            f"init_from must hold the weights of an agent with the same networks, got others: "
            f"{'; '.join(differing[:_SHOWN])}{more}; use the algo and network of that run, and a task with "
            "observations, actions and subgoals of the same shapes."
        )
    for name, parameter in wanted.items():
        parameter.copy_(found[name])
    for learner in algorithm.learners.values():
        learner.copy_to_target()
    for monitor in algorithm.monitors.values():
        if isinstance(monitor, Discovery):
            monitor.take_over()


def _is_of_exploration(name: str) -> bool:
    """Schedules are buffers of the policy, too."""
    return any(part.endswith("exploration") for part in name.split("."))


def _shape(value: Tensor | None) -> str:
    return "missing" if value is None else str(list(value.shape))
