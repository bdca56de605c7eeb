"""What the builders read from an environment, checked before anything is built."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import NestedKey
from torchrl.data import Binary, Bounded, Categorical, MultiCategorical, MultiOneHot, OneHot, TensorSpec
from torchrl.envs import EnvBase, GymWrapper
from torchrl.envs.transforms import TransformedEnv

from hdrqn_torchrl import keys
from hdrqn_torchrl.algorithms.levels import Level, make_levels
from hdrqn_torchrl.envs import SubgoalSet, Task, task_of
from hdrqn_torchrl.modules import Architecture
from hdrqn_torchrl.transforms.entries import Entries, describe

_REMEDIES: tuple[tuple[type[TensorSpec], str], ...] = (
    (MultiOneHot, "give each combination of its parts one number, and pass categorical_action_encoding=True"),
    (OneHot, "pass categorical_action_encoding=True to GymEnv or GymWrapper"),
    (MultiCategorical, "give each combination of its parts one number"),
    (Bounded, "make it discrete, with torchrl.envs.transforms.ActionDiscretizer for instance"),
    (Binary, "give each combination of its bits one number"),
)


@dataclass(frozen=True, kw_only=True)
class Requirements:
    """What a builder needs to know of its environment.

    Args:
        num_envs: N.
        observation: spec of ``[N, ...]``.
        num_actions: how many there are.
        subgoals: the sets of subgoals that the agent pursues, from near to far; none for a flat agent.
        available_keys: for each of them, the entry that tells which are worth choosing, or ``None``.
        hazard_key: an entry that not every environment has, or ``None``.
        task: what the environment states.
    """

    num_envs: int
    observation: TensorSpec
    num_actions: int
    subgoals: tuple[SubgoalSet, ...]
    available_keys: tuple[NestedKey | None, ...]
    hazard_key: NestedKey | None
    task: Task

    @property
    def num_subgoals(self) -> int:
        """G of the farthest set; 0 for a flat agent."""
        return len(self.subgoals[-1]) if self.subgoals else 0

    @property
    def available_key(self) -> NestedKey | None:
        """The farthest set's entry that tells which subgoals are worth choosing, if there is one."""
        return self.available_keys[-1] if self.available_keys else None

    @property
    def levels(self) -> tuple[Level, ...]:
        """The agent's levels, from level 0 up."""
        return make_levels(self.num_actions, self.subgoals)

    @property
    def hazard_keys(self) -> list[NestedKey]:
        """The hazard's entry, if there is one."""
        return [] if self.hazard_key is None else [self.hazard_key]


def check_environment(env: EnvBase, architecture: Architecture, *, builder: str, levels: int) -> Requirements:
    """Reads the specs of an environment.

    Args:
        env: bare environment.
        architecture: what reads the observation.
        builder: named in the error.
        levels: of the agent; it pursues the last ``levels - 1`` sets of subgoals of the task.

    Raises:
        ValueError: naming everything that is missing or wrong, and what the environment has; or if the task has fewer
            sets of subgoals.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> needs = check_environment(MultiGoalGridEnv(4), compact_network(), builder="make_v3", levels=2)
        >>> needs.num_actions, needs.num_subgoals, [level.name for level in needs.levels]
        (4, 2, ['sub', 'meta'])
    """
    entries, task = Entries.of(env), task_of(env)
    _check_levels(levels, task)
    _check_batch(entries)
    _check_resets(env, entries)
    _check_observation(entries, architecture)
    _check_action(entries)
    for key in (keys.DONE, keys.TERMINATED):
        entries.require_flags(key)
    entries.require_number(keys.REWARD)
    if levels > 1:
        entries.require_number(keys.EXTRINSIC_REWARD)
    subgoals = _subgoals(entries, task, levels - 1)
    available = tuple(each.keys.available if each.keys.available in entries else None for each in subgoals)
    for each, available_key in zip(subgoals, available, strict=True):
        if available_key is not None:
            entries.require_flags(available_key, len(each))
    for key in (keys.HAZARD, keys.SUCCESS):
        if key in entries and (levels > 1 or key == keys.SUCCESS):
            entries.require_flags(key)
    entries.check(builder)
    return Requirements(
        num_envs=env.batch_size[0],
        observation=entries.specs[keys.OBSERVATION],
        num_actions=entries.specs[keys.ACTION].n,
        subgoals=subgoals,
        available_keys=available,
        hazard_key=keys.HAZARD if levels > 1 and keys.HAZARD in entries else None,
        task=task,
    )


def _check_levels(levels: int, task: Task) -> None:
    """Refuses an agent of more levels than the task has sets of subgoals for."""
    most = max(1, len(task.subgoals)) + 1
    if not 1 <= levels <= most:
        raise ValueError(
            f"levels must lie in [1, {most}], got {levels}: the task states {len(task.subgoals)} sets of subgoals, and "
            "each level above the first chooses among one; state more of them (Task.subgoals)."
        )


def _subgoals(entries: Entries, task: Task, number: int) -> tuple[SubgoalSet, ...]:
    """The farthest sets of subgoals, as many as ``number``; their ``attained`` is checked."""
    if not number:
        return ()
    stated = task.subgoals[-number:]
    for each in stated:
        entries.require_flags(each.keys.attained, len(each))
    if stated:
        return stated
    entries.require_flags(keys.ATTAINED, None)
    size = entries.specs[keys.ATTAINED].shape[-1] if keys.ATTAINED in entries else 0
    return (SubgoalSet(names=tuple(f"subgoal {index}" for index in range(size))),) if size else ()


def _check_batch(entries: Entries) -> None:
    if len(entries.batch_size) != 1:
        remedy = (
            "collect several at a time, with SerialEnv(16, make_env)"
            if not entries.batch_size
            else "use one batch of environments, not a batch of batches"
        )
        entries.problems.append(f"the batch size must be [N], got {list(entries.batch_size)}; {remedy}")


def _check_resets(env: EnvBase, entries: Entries) -> None:
    """TorchRL reads what Gymnasium's vectors report of a last step in SAME_STEP mode for plain observations only."""
    observed = set(env.observation_spec.keys(True, True))
    while isinstance(env, TransformedEnv):
        env = env.base_env
    if not isinstance(env, GymWrapper):
        return
    mode = (env._env.metadata or {}).get("autoreset_mode")
    if getattr(mode, "name", None) == "SAME_STEP" and observed != {keys.OBSERVATION}:
        entries.problems.append(
            "a vector of Gymnasium environments with more entries than the observation must leave resets to TorchRL, "
            "got autoreset_mode=SAME_STEP; use AutoresetMode.DISABLED"
        )


def _check_observation(entries: Entries, architecture: Architecture) -> None:
    spec = entries.specs.get(keys.OBSERVATION)
    if spec is None:
        entries.problems.append(f"{keys.OBSERVATION!r} must be what the agent sees, it is missing")
        return
    problem = architecture.observation_problem(spec, spec.shape[len(entries.batch_size) :])
    if problem is not None:
        rule, remedy = problem
        entries.problems.append(f"{keys.OBSERVATION!r} must be {rule}, got {describe(spec)}; {remedy}")


def _check_action(entries: Entries) -> None:
    spec = entries.specs.get(keys.ACTION)
    rule = f"{keys.ACTION!r} must be one number of n, {list(entries.batch_size)} int64 (Categorical)"
    if spec is None:
        entries.problems.append(f"{rule}, it is missing")
    elif type(spec) is not Categorical or spec.shape != entries.batch_size:
        remedies = (text for kind, text in _REMEDIES if isinstance(spec, kind))
        remedy = next(remedies, "let it have the environment's batch size")
        entries.problems.append(f"{rule}, got {describe(spec)}; {remedy}")
