"""What builders return, and functions that several of them share."""

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
from hdrqn_torchrl.envs import SubgoalSet, Task
from hdrqn_torchrl.learning import Learner, LearnerSettings, Monitor
from hdrqn_torchrl.modules import AllSubgoalsPolicy, EpsilonGreedy, MetaController, SubController
from hdrqn_torchrl.objectives import RecurrentDQNLoss

Controller = SubController | MetaController | AllSubgoalsPolicy


@dataclass(frozen=True, kw_only=True)
class Algorithm:
    """A policy, its learners, and what training them needs.

    Args:
        policy: makes the choices of all levels.
        learners: by name; one per level in most algorithms.
        explorations: one per level, by the level's name.
        make_transforms: makes the transforms that the environment needs.
        monitors: what is counted besides the learning, by name.
        levels: entries with the decisions of each level, from level 0 up, for watching.
        task: what the environment states about itself.

    Examples:
        >>> from torchrl.collectors import Collector
        >>> from hdrqn_torchrl.algorithms import make_hdrqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> env = MultiGoalGridEnv(num_envs=2)
        >>> agent = make_hdrqn(env, compact_network(8, (8,)))
        >>> sizes = {"frames_per_batch": 32, "total_frames": 64}
        >>> collector = Collector(agent.transform(env), agent.policy, **sizes, auto_register_policy_transforms=False)
        >>> for batch in collector:
        ...     agent.observe(batch)
        >>> {name: learner.frames for name, learner in agent.learners.items()}
        {'sub': 64, 'meta': 64}
    """

    policy: TensorDictModuleBase
    learners: dict[str, Learner]
    explorations: dict[str, EpsilonGreedy]
    make_transforms: Callable[[], Compose]
    monitors: dict[str, Monitor] = field(default_factory=dict)
    levels: tuple[LevelView, ...] = ()
    task: Task = field(default_factory=Task)

    @property
    def found(self) -> list[int] | None:
        """Frames after which each of its subgoals was found; ``None`` if they were given."""
        critic = getattr(self.policy, "critic", None)
        return None if critic is None else critic.table.found.tolist()

    @property
    def pursued(self) -> tuple[SubgoalSet, ...]:
        """Sets of subgoals of the task that its levels pursue, from near to far; none if it finds its own."""
        number = 0 if self.found is not None else len(self.levels) - 1
        return self.task.subgoals[-number:] if number > 0 else ()

    @property
    def updates(self) -> int:
        """Gradient steps of all learners together."""
        return sum(learner.updates for learner in self.learners.values())

    def figures(self) -> dict[str, float]:
        """Of each learner and exploration, for a row of the table."""
        learners, explorations = self.learners.items(), self.explorations.items()
        return {
            **{f"{name}/updates": learner.updates for name, learner in learners},
            **{f"{name}/learning_rate": learner.learning_rate for name, learner in learners},
            **{f"{name}/epsilon": level.epsilon.item() for name, level in explorations},
        }

    def transform(self, env: EnvBase) -> TransformedEnv:
        """The environment with the transforms that this algorithm needs."""
        return TransformedEnv(env, self.make_transforms(), auto_unwrap=True)

    def observe(self, batch: TensorDictBase) -> None:
        """Processes a collected batch ``[N, T]``: learners store it, exploration schedules advance, monitors count.

        Updates may be due afterwards (:meth:`Learner.updates_due`).
        """
        for learner in self.learners.values():
            learner.store(batch)
        for exploration in self.explorations.values():
            exploration.step(batch.numel())
            exploration.observe(batch)
        for monitor in self.monitors.values():
            monitor.observe(batch)


def copies_of(*transforms: Transform) -> Callable[[], Compose]:
    """A function that copies transforms for another environment; it can be pickled for another process."""
    return partial(_copy, transforms)


def _copy(transforms: Sequence[Transform]) -> Compose:
    return Compose(*deepcopy(transforms))


def require_settings(**given: object) -> None:
    """Refuses settings of learners, by the name of their argument, that are something else.

    Raises:
        ValueError: naming the argument.
    """
    for name, each in given.items():
        if not isinstance(each, LearnerSettings):
            raise ValueError(
                f"{name} must be LearnerSettings, got {each!r}; dataclasses.replace changes some of others, "
                "for instance replace(V3_LEARNER, batch_size=16)."
            )


@contextmanager
def settings_named(name: str) -> Iterator[None]:
    """Puts the name of the argument before errors about fields of its :class:`LearnerSettings`."""
    try:
        yield
    except ValueError as error:
        if str(error).partition(" ")[0] in {each.name for each in fields(LearnerSettings)}:
            raise ValueError(f"{name}.{error}") from error
        raise


def stored_states(network: Controller, settings: LearnerSettings) -> list[NestedKey]:
    """Entries of the recurrent state to store with each step; empty without ``settings.stored_state``.

    Raises:
        ValueError: if ``settings.stored_state`` is set for a network without memory.
    """
    if settings.stored_state and not network.state_keys:
        raise ValueError("stored_state must be False for networks without memory, got True; they have no state.")
    return network.state_keys if settings.stored_state else []


def largest_target(setting: float | Literal["unbounded"] | None, stated: float) -> float:
    """The upper bound of targets by a setting; ``None``: the one that the task states."""
    if setting is None:
        return stated
    return math.inf if setting == "unbounded" else setting


def make_recurrent_loss(
    network: SubController | MetaController,
    settings: LearnerSettings,
    *,
    gamma: float = 0.99,
    largest_return: float = math.inf,
    smallest_return: float = -math.inf,
    loss_keys: Mapping[str, NestedKey | None] | None = None,
    prediction_weight: float = 0.1,
) -> RecurrentDQNLoss:
    """The loss of one level, built from its settings, for sequences that store each observation once.

    Args:
        network: the controller to train.
        settings: how it learns.
        gamma: discount of one environment step.
        largest_return: upper bound of the targets if ``settings.max_target`` is ``None``.
        smallest_return: their lower bound, unless ``settings.max_target`` is ``"unbounded"``.
        loss_keys: keys that differ from what the network states, for :meth:`RecurrentDQNLoss.set_keys`.
        prediction_weight: weight of the error of the network's predictor, if it has one.

    Raises:
        ValueError: if ``settings.stored_state`` is set for a network without memory.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> spec = MultiGoalGridEnv(num_envs=2).observation_spec["observation"]
        >>> network = compact_network(8, (8,)).q_network(spec, num_actions=4)
        >>> controller = SubController(network, subgoal_key=None, init_key="is_init")
        >>> loss = make_recurrent_loss(controller, LearnerSettings(slice_len=4, n_step=3), largest_return=2.0)
        >>> loss.lookahead
        3
    """
    loss = RecurrentDQNLoss(
        network,
        gamma=gamma,
        burn_in=settings.burn_in,
        train_exact_states=settings.train_exact_states,
        loss_function=settings.loss_function,
        double=settings.double,
        max_target=largest_target(settings.max_target, largest_return),
        min_target=-math.inf if settings.max_target == "unbounded" else smallest_return,
        trace_decay=settings.trace_decay,
        n_step=settings.n_step,
        lookahead=1 + settings.lookahead(),  # observations are stored once
        state_keys=stored_states(network, settings),
        predictor=network.network.predictor,
        prediction_weight=prediction_weight,
    )
    loss.set_keys(**(loss_keys or {}))
    return loss
