"""What a task states about itself, so that nothing has to be guessed from names of settings or sizes of rewards."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from numbers import Integral, Real
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray
from tensordict import NestedKey
from tensordict.utils import is_seq_of_nested_key
from torch.nn import Module
from torchrl.envs import EnvBase
from torchrl.envs.batched_envs import BatchedEnvBase
from torchrl.envs.transforms import StepCounter, TransformedEnv

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.subgoals import SubgoalSet, check_flag, check_names, check_sets
from hdrqn_torchrl.envs.symmetry import Symmetry, check_symmetries
from hdrqn_torchrl.random_numbers import own_random_numbers
from hdrqn_torchrl.transforms import Critic

if TYPE_CHECKING:
    from hdrqn_torchrl.envs.scene import Scene  # whose pictures take a second to load

Figures = Mapping[str, float]


class SceneFactory(Protocol):
    """Makes a scene of the present moment of an environment with one world."""

    def __call__(self, env: EnvBase, *, subgoal: int | None = None, action: int | None = None) -> Scene:
        """See :func:`~hdrqn_torchrl.rendering.scene_of`."""
        ...


@dataclass(frozen=True, kw_only=True)
class Reference:
    """A scripted player that marks what can be achieved on a task. It plays only when asked to.

    Figures are means over episodes: ``return_mean`` and, as far as there are any, ``success_rate``, ``steps_mean`` and
    ``episodes``.

    Args:
        what: it knows, in a few words.
        play: plays and returns the figures; takes the seconds it may need (``None``: as many as it needs), and raises
            ``TimeoutError`` if they are not enough.
        known: figures that were measured earlier.
        key: names player and task: the same key, the same figures. They are then kept on disk; empty: they are not.

    Examples:
        >>> Reference(what="chance", play=lambda seconds: {"return_mean": 0.5}).play(None)
        {'return_mean': 0.5}
    """

    what: str
    play: Callable[[float | None], Figures]
    known: Figures | None = None
    key: str = ""


@dataclass(frozen=True, kw_only=True)
class Task:
    """What an environment says about its task, in an attribute ``task``. What it leaves out is unknown.

    A return is the sum of the rewards from any step of an episode on, discounted or not.

    Args:
        max_steps: longest episode in steps; ``None``: unknown, or there is no end.
        largest_return: largest return there can be of ``reward``.
        largest_extrinsic_return: largest return there can be of ``extrinsic_reward``.
        smallest_extrinsic_return: smallest one; 0 where that reward is never negative.
        subgoals: sets of subgoals, from near to far; an agent of L levels pursues the last L - 1 of them. If empty,
            there is one set, whose size is that of ``attained``.
        ordered: whether the farthest subgoals are to be attained one after the other, as they are numbered. Then the
            share of them that were is counted, as ``in_order``.
        success: entry that says whether a step completed the whole task, if the environment writes it.
        actions: names of the actions.
        references: scripted players by name.
        ceiling: name of the one that learning curves are drawn against.
        symmetries: ways to turn or mirror its worlds that leave the task as it is, but for leaving them as they are.
        scene: makes a picture of the present moment; ``None``: what the environment's ``render`` returns or, failing
            that, text.
        screen: a picture ``[height, width, 3]`` of where an episode begins, for environments whose entry ``position``
            gives the agent's place on it.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> Task(max_steps=50, largest_return=2.0).largest_return
        2.0
    """

    max_steps: int | None = None
    largest_return: float = math.inf
    largest_extrinsic_return: float = math.inf
    smallest_extrinsic_return: float = -math.inf
    subgoals: tuple[SubgoalSet, ...] = ()
    ordered: bool = False
    success: NestedKey = keys.SUCCESS
    actions: tuple[str, ...] = ()
    references: Mapping[str, Reference] = field(default_factory=dict)
    ceiling: str | None = None
    symmetries: tuple[Symmetry, ...] = ()
    scene: SceneFactory | None = None
    screen: Callable[[EnvBase], NDArray[np.uint8]] | None = None

    def __post_init__(self) -> None:
        _check_length(self.max_steps)
        _check_bounds(self.largest_return, self.smallest_extrinsic_return, self.largest_extrinsic_return)
        object.__setattr__(self, "subgoals", check_sets(self.subgoals))
        object.__setattr__(self, "actions", check_names("actions", self.actions))
        object.__setattr__(self, "symmetries", check_symmetries(self.symmetries))
        check_flag("ordered", self.ordered)
        if not (isinstance(self.success, str) or is_seq_of_nested_key([self.success])):
            raise ValueError(f'success must be the name of an entry, got {self.success!r}; use "success".')
        for name, drawing in (("scene", self.scene), ("screen", self.screen)):
            if drawing is not None and not callable(drawing):
                raise ValueError(f"{name} must be a function or None, got {drawing!r}; None: there is none.")
        _check_references(self.references, self.ceiling)

    def within(self, max_steps: int | None) -> Task:
        """The same task with episodes that are cut off after ``max_steps`` steps, if not before."""
        limits = [limit for limit in (self.max_steps, max_steps) if limit is not None]
        shorter = replace(self, max_steps=min(limits, default=None))
        return self if shorter == self else shorter.without_references()

    def without_references(self) -> Task:
        """The same task for which scripted players don't play."""
        return replace(self, references={}, ceiling=None)

    def without_returns(self) -> Task:
        """The same task with rewards of whose sums nothing is known."""
        return replace(
            self.without_references(), largest_return=math.inf, largest_extrinsic_return=math.inf,
            smallest_extrinsic_return=-math.inf,
        )  # fmt: skip


def _check_length(max_steps: int | None) -> None:
    whole = isinstance(max_steps, Integral) and not isinstance(max_steps, bool)
    if max_steps is not None and not (whole and max_steps >= 1):
        raise ValueError(f"max_steps must be a whole number >= 1 or None, got {max_steps!r}; None: unknown.")


def _check_bounds(largest: float, smallest_extrinsic: float, largest_extrinsic: float) -> None:
    bounds = {
        "largest_return": largest,
        "smallest_extrinsic_return": smallest_extrinsic,
        "largest_extrinsic_return": largest_extrinsic,
    }
    for name, bound in bounds.items():
        if not isinstance(bound, Real) or math.isnan(bound):
            raise ValueError(f"{name} must be a number, got {bound!r}; leave out what is not known.")
    if smallest_extrinsic > largest_extrinsic:
        raise ValueError(
            f"smallest_extrinsic_return must be <= largest_extrinsic_return={largest_extrinsic}, got "
            f"{smallest_extrinsic}; leave out what is not known."
        )


def _check_references(references: Mapping[str, Reference], ceiling: str | None) -> None:
    known = isinstance(references, Mapping) and all(isinstance(each, Reference) for each in references.values())
    if not known:
        raise ValueError(
            f'references must be {{"name": Reference(...)}}, got {references!r}; leave out what there is not.'
        )
    if ceiling is not None and ceiling not in references:
        raise ValueError(
            f"ceiling must be one of the references {sorted(references)}, got {ceiling!r}; None: there is no line."
        )


def task_of(env: EnvBase) -> Task:
    """What an environment says about its task, found through transforms, wrappers and batches of environments.

    The length of an episode is also read from ``StepCounter`` and from the limits of Gymnasium. Behind a transform that
    changes rewards nothing is known of their sums.

    Args:
        env: any environment. Of a batch of environments, a new copy of the first one is asked.

    Examples:
        >>> from torchrl.envs import StepCounter, TransformedEnv
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> task_of(TransformedEnv(MultiGoalGridEnv(4, max_steps=50), StepCounter(max_steps=20))).max_steps
        20
    """
    if isinstance(env, TransformedEnv):
        task = task_of(env.base_env)
        for transform in env.transform.modules():
            task = _through(transform, task)
        return task
    if isinstance(env, BatchedEnvBase):
        return _task_of_worker(env)
    wrapped = getattr(env, "_env", None)  # of GymWrapper
    for source in (env, getattr(wrapped, "unwrapped", None)):
        if isinstance(stated := getattr(source, "task", None), Task):
            return stated.within(_gymnasium_limit(wrapped))
    return Task(max_steps=_gymnasium_limit(wrapped))


def _through(transform: Module, task: Task) -> Task:
    """What is left of a statement behind a transform: what it changes is not what was stated."""
    if isinstance(transform, StepCounter):
        task = task.within(transform.max_steps)
    if isinstance(transform, Critic):
        task = _with_subgoals(task, transform)
    if callable(restate := getattr(transform, "restated", None)):  # as that of discovered subgoals does
        task = restate(task)
    written = getattr(transform, "out_keys", [])
    if keys.REWARD in written:
        task = replace(task.without_references(), largest_return=math.inf)
    if keys.EXTRINSIC_REWARD in written:
        task = replace(task, largest_extrinsic_return=math.inf, smallest_extrinsic_return=-math.inf)
    if keys.OBSERVATION in written or keys.ACTION in getattr(transform, "in_keys_inv", []):
        task = replace(task, symmetries=())
    return task


def _with_subgoals(task: Task, critic: Critic) -> Task:
    """The task with the critic's set of subgoals in place of the one with the same prefix, or as one more."""
    own = SubgoalSet(names=critic.names, prefix=critic.prefix, repeatable=critic.repeatable)
    sets = [own if each.prefix == own.prefix else each for each in task.subgoals]
    if own not in sets:
        sets = [own, *sets] if own.prefix else [*sets, own]
    return replace(task, subgoals=tuple(sets), symmetries=())  # it may look at places


def _task_of_worker(env: BatchedEnvBase) -> Task:
    """Asked of a new one: a worker process that lacks an attribute ends when it is asked for it."""
    with own_random_numbers():  # reading it changes nothing
        worker = env.create_env_fn[0](**env.create_env_kwargs[0])
    try:
        return task_of(worker)
    finally:
        worker.close()


def _gymnasium_limit(wrapped: object) -> int | None:
    """The shortest time limit among an environment's wrappers, or the one it is registered with."""
    limits = [getattr(getattr(wrapped, "spec", None), "max_episode_steps", None)]
    while wrapped is not None:
        limits.append(getattr(wrapped, "_max_episode_steps", None))  # of gymnasium.wrappers.TimeLimit
        wrapped = getattr(wrapped, "env", None)
    return min((limit for limit in limits if isinstance(limit, int) and limit > 0), default=None)
