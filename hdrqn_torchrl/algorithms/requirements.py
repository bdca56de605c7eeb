"""What the builders read from an environment, checked before anything is built."""

from __future__ import annotations

from dataclasses import dataclass, replace

from tensordict import NestedKey
from torchrl.data import Binary, Bounded, Categorical, MultiCategorical, MultiOneHot, OneHot, TensorSpec
from torchrl.envs import EnvBase, GymWrapper
from torchrl.envs.transforms import TransformedEnv

from hdrqn_torchrl import keys
from hdrqn_torchrl.algorithms.levels import Level, make_levels
from hdrqn_torchrl.envs import SubgoalSet, Task, task_of
from hdrqn_torchrl.envs.specs import check_is_environment
from hdrqn_torchrl.modules import Architecture
from hdrqn_torchrl.modules.sizes import check_size
from hdrqn_torchrl.transforms.entries import Entries, describe

_REMEDIES: tuple[tuple[type[TensorSpec], str], ...] = (
    (MultiOneHot, "number the combinations of its parts, and pass categorical_action_encoding=True"),
    (OneHot, "pass categorical_action_encoding=True to GymEnv or GymWrapper"),
    (MultiCategorical, "number the combinations of its parts"),
    (Bounded, "make it discrete, for instance with torchrl.envs.transforms.ActionDiscretizer"),
    (Binary, "number the combinations of its bits"),
)


@dataclass(frozen=True, kw_only=True)
class Requirements:
    """What a builder needs to know about its environment.

    Args:
        num_envs: N.
        observation: spec of the observation ``[N, ...]``.
        num_actions: number of actions.
        subgoals: the sets of subgoals that the agent pursues, from near to far; empty for a flat agent.
        available_keys: for each set, the entry that marks the subgoals worth choosing, or ``None``.
        action_mask_key: the entry that marks the actions that can be chosen, or ``None``.
        hazard_key: the entry that marks the hazard; ``None`` if the environment or the agent has none.
        task: what the environment states about itself.
        finds_subgoals: whether the agent finds them itself.
    """

    num_envs: int
    observation: TensorSpec
    num_actions: int
    subgoals: tuple[SubgoalSet, ...]
    available_keys: tuple[NestedKey | None, ...]
    action_mask_key: NestedKey | None
    hazard_key: NestedKey | None
    task: Task
    finds_subgoals: bool = False

    @property
    def levels(self) -> tuple[Level, ...]:
        """The agent's levels, from level 0 up."""
        return make_levels(self.num_actions, self.subgoals)

    @property
    def action_mask_keys(self) -> list[NestedKey]:
        """The action mask's entry, if there is one."""
        return [] if self.action_mask_key is None else [self.action_mask_key]

    @property
    def hazard_keys(self) -> list[NestedKey]:
        """The hazard's entry, if there is one."""
        return [] if self.hazard_key is None else [self.hazard_key]

    @property
    def event_keys(self) -> list[NestedKey]:
        """The entry with the events of a step, where the agent finds its subgoals itself."""
        return [keys.EVENTS] if self.finds_subgoals else []


def check_environment(
    env: EnvBase,
    architecture: Architecture,
    *,
    builder: str,
    levels: int,
    discovered: SubgoalSet | None = None,
    bonus: bool = False,
) -> Requirements:
    """Checks the specs of an environment and collects what a builder needs to know.

    Args:
        env: bare environment.
        architecture: the networks that will read the observation.
        builder: name of the builder, for the error.
        levels: number of the agent's levels; it pursues the task's last ``levels - 1`` sets of subgoals.
        discovered: the set that the agent finds itself, and pursues in their place.
        bonus: whether the agent is paid for the farthest set of subgoals without pursuing it.

    Raises:
        ValueError: with everything that is missing or wrong and what the environment has, or if the task has too few
            sets of subgoals.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> needs = check_environment(MultiGoalGridEnv(4), compact_network(), builder="make_v3", levels=2)
        >>> needs.num_actions, [level.name for level in needs.levels]
        (4, ['sub', 'meta'])
    """
    check_is_environment(env)
    if not isinstance(architecture, Architecture):
        raise ValueError(f"architecture must be an Architecture, got {architecture!r}; use compact_network().")
    entries, task = Entries.of(env), task_of(env)
    if discovered is not None:
        task = replace(task, subgoals=(discovered,), ordered=False)
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
    if bonus:
        _subgoals(entries, task, 1)
    subgoals = _subgoals(entries, task, levels - 1) if discovered is None else (discovered,)
    available = _available(entries, subgoals) if discovered is None else (discovered.keys.available,)
    for key in (keys.HAZARD, keys.SUCCESS):
        if key in entries and (levels > 1 or key == keys.SUCCESS):
            entries.require_flags(key)
    if keys.ACTION_MASK in entries:
        entries.require_flags(keys.ACTION_MASK, getattr(entries.specs.get(keys.ACTION), "n", None))
    entries.check(builder)
    return Requirements(
        num_envs=env.batch_size[0],
        observation=entries.specs[keys.OBSERVATION],
        num_actions=entries.specs[keys.ACTION].n,
        subgoals=subgoals,
        available_keys=available,
        action_mask_key=keys.ACTION_MASK if keys.ACTION_MASK in entries else None,
        hazard_key=keys.HAZARD if levels > 1 and keys.HAZARD in entries else None,
        task=task,
        finds_subgoals=discovered is not None,
    )


def _check_levels(levels: int, task: Task) -> None:
    """Refuses more levels than the task has sets of subgoals for."""
    check_size("levels", levels, 2)
    most = max(1, len(task.subgoals)) + 1
    if levels > most:
        raise ValueError(
            f"levels must be <= {most}, got {levels}: the task states {len(task.subgoals)} sets of subgoals, and "
            "each level above the first chooses among one of them; use fewer levels, or add sets to Task.subgoals."
        )


def _subgoals(entries: Entries, task: Task, number: int) -> tuple[SubgoalSet, ...]:
    """The ``number`` farthest sets of subgoals, after checking their ``attained`` entries."""
    if not number:
        return ()
    stated = task.subgoals[-number:]
    for each in stated:
        entries.require_flags(each.keys.attained, len(each))
    if stated:
        return stated
    if keys.ATTAINED not in entries:
        shape = ", ".join(map(str, [*entries.batch_size, "G"]))
        entries.problems.append(
            f"{keys.ATTAINED!r} must be [{shape}] bool, it is missing: the task states no subgoals; "
            "give make_gym some (env.subgoals=my_package.MySubgoals), or use a flat agent"
        )
        return ()
    entries.require_flags(keys.ATTAINED, None)
    size = entries.specs[keys.ATTAINED].shape[-1] if keys.ATTAINED in entries else 0
    return (SubgoalSet(names=tuple(f"subgoal {index}" for index in range(size))),) if size else ()


def _available(entries: Entries, subgoals: tuple[SubgoalSet, ...]) -> tuple[NestedKey | None, ...]:
    """For each set, the entry that marks the subgoals worth choosing, or ``None``, after checking it."""
    available = tuple(each.keys.available if each.keys.available in entries else None for each in subgoals)
    for each, available_key in zip(subgoals, available, strict=True):
        if available_key is not None:
            entries.require_flags(available_key, len(each))
    return available


def _check_batch(entries: Entries) -> None:
    if entries.batch_size == (0,):
        entries.problems.append("the batch size must be [N] with N >= 1, got [0]; use 16 environments")
    if len(entries.batch_size) != 1:
        remedy = (
            "use several environments, for instance SerialEnv(16, make_env)"
            if not entries.batch_size
            else "use one batch of environments, not a batch of batches"
        )
        entries.problems.append(f"the batch size must be [N], got {list(entries.batch_size)}; {remedy}")


def _check_resets(env: EnvBase, entries: Entries) -> None:
    """In SAME_STEP mode, TorchRL reads an episode's last step from Gymnasium's vectors for plain observations only."""
    observed = set(env.observation_spec.keys(True, True))
    while isinstance(env, TransformedEnv):
        env = env.base_env
    if not isinstance(env, GymWrapper):
        return
    mode = (env._env.metadata or {}).get("autoreset_mode")
    if getattr(mode, "name", None) == "SAME_STEP" and observed != {keys.OBSERVATION}:
        entries.problems.append(
            "the autoreset_mode of a vector of Gymnasium environments that has more entries than the observation must "
            "be DISABLED, got SAME_STEP; pass AutoresetMode.DISABLED"
        )


def _check_observation(entries: Entries, architecture: Architecture) -> None:
    spec = entries.specs.get(keys.OBSERVATION)
    if spec is None:
        nested = [key[1:] for key in entries.specs if isinstance(key, tuple) and key[0] == keys.OBSERVATION]
        remedy = (
            f"it is made of several, {sorted('.'.join(key) for key in nested)}: join them, for instance with "
            "CatTensors, or make the environment with make_gym"
        )
        entries.problems.append(
            f"{keys.OBSERVATION!r} must be what the agent sees, {remedy if nested else 'it is missing'}"
        )
        return
    problem = architecture.observation_problem(spec, spec.shape[len(entries.batch_size) :])
    if problem is not None:
        rule, remedy = problem
        entries.problems.append(f"{keys.OBSERVATION!r} must be {rule}, got {describe(spec)}; {remedy}")


def _check_action(entries: Entries) -> None:
    spec = entries.specs.get(keys.ACTION)
    rule = f"{keys.ACTION!r} must be one integer below n, {list(entries.batch_size)} int64 (Categorical)"
    if spec is None:
        entries.problems.append(f"{rule}, it is missing")
    elif type(spec) is not Categorical or spec.shape != entries.batch_size:
        remedies = (text for kind, text in _REMEDIES if isinstance(spec, kind))
        remedy = next(remedies, "give it the environment's batch size")
        entries.problems.append(f"{rule}, got {describe(spec)}; {remedy}")
