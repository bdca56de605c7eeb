"""What a builder returns, and what several of them share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Literal

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, Transform, TransformedEnv

from hdrqn_torchrl.algorithms.views import LevelView
from hdrqn_torchrl.envs import Task
from hdrqn_torchrl.learning import Learner, LearnerSettings, Monitor
from hdrqn_torchrl.modules import AllSubgoalsPolicy, EpsilonGreedy, MetaController, SubController
from hdrqn_torchrl.objectives import RecurrentDQNLoss

Controller = SubController | MetaController | AllSubgoalsPolicy


@dataclass(frozen=True, kw_only=True)
class Algorithm:
    """A policy, its learners and all that goes with them.

    Args:
        policy: chooses at all levels.
        learners: by name; most algorithms have one per level.
        explorations: of the levels, by name.
        make_transforms: makes the transforms that its environment needs.
        monitors: what is counted besides the learning, by name.
        levels: where the levels' decisions are read, from level 0 up, for those who watch.
        task: what the environment states.
    """

    policy: TensorDictModuleBase
    learners: dict[str, Learner]
    explorations: dict[str, EpsilonGreedy]
    make_transforms: Callable[[], Compose]
    monitors: dict[str, Monitor] = field(default_factory=dict)
    levels: tuple[LevelView, ...] = ()
    task: Task = field(default_factory=Task)

    def transform(self, env: EnvBase) -> TransformedEnv:
        """The environment as this algorithm sees it."""
        return TransformedEnv(env, self.make_transforms(), auto_unwrap=True)

    def observe(self, batch: TensorDictBase) -> None:
        """Takes in a collected batch ``[N, T]``: every learner stores it, schedules go on, monitors watch.

        Updates are then due (:meth:`Learner.updates_due`).
        """
        for learner in self.learners.values():
            learner.store(batch)
        for exploration in self.explorations.values():
            exploration.step(batch.numel())
            exploration.observe(batch)
        for monitor in self.monitors.values():
            monitor.observe(batch)


def copies_of(*transforms: Transform) -> Callable[[], Compose]:
    """A function that makes copies of transforms, for one more environment; it can be sent to another process."""
    return partial(_copy, transforms)


def _copy(transforms: Sequence[Transform]) -> Compose:
    return Compose(*deepcopy(transforms))


@contextmanager
def settings_named(name: str) -> Iterator[None]:
    """Complaints about a level's :class:`LearnerSettings` are told under the argument that holds them."""
    try:
        yield
    except ValueError as error:
        if str(error).partition(" ")[0] in {each.name for each in fields(LearnerSettings)}:
            raise ValueError(f"{name}.{error}") from error
        raise


def stored_states(network: Controller, settings: LearnerSettings) -> list[NestedKey]:
    """The recurrent states that are stored with the steps: all or none.

    Raises:
        ValueError: if ``settings.stored_state`` is asked of a network without memory.
    """
    if settings.stored_state and not network.state_keys:
        raise ValueError("stored_state must be False without recurrence, got True; such a network has no state.")
    return network.state_keys if settings.stored_state else []


def largest_target(setting: float | Literal["unbounded"] | None, stated: float) -> float:
    """The bound of targets that a setting asks for; ``None``: what the task states."""
    if setting is None:
        return stated
    return math.inf if setting == "unbounded" else setting


def make_recurrent_loss(
    network: SubController | MetaController,
    settings: LearnerSettings,
    *,
    gamma: float = 0.99,
    largest_return: float = math.inf,
    loss_keys: Mapping[str, NestedKey | None] | None = None,
    prediction_weight: float = 0.1,
) -> RecurrentDQNLoss:
    """The loss of one level, as its settings have it, for sequences that hold each observation once.

    Args:
        network: the controller that is trained.
        settings: how it learns.
        gamma: discount of one environment step.
        largest_return: bounds the targets where ``settings.max_target`` is ``None``.
        loss_keys: for :meth:`RecurrentDQNLoss.set_keys`, where they are not the default ones.
        prediction_weight: of the error of the network's predictor, if it has one.

    Raises:
        ValueError: if ``settings.stored_state`` is asked of a network without memory.
    """
    loss = RecurrentDQNLoss(
        network,
        gamma=gamma,
        burn_in=settings.burn_in,
        train_exact_states=settings.train_exact_states,
        loss_function=settings.loss_function,
        double=settings.double,
        max_target=largest_target(settings.max_target, largest_return),
        trace_decay=settings.trace_decay,
        n_step=settings.n_step,
        lookahead=1 + settings.lookahead(),  # observations are stored once
        state_keys=stored_states(network, settings),
        predictor=network.network.predictor,
        prediction_weight=prediction_weight,
    )
    loss.set_keys(action_value=network.action_value_key, **(loss_keys or {}))
    return loss
