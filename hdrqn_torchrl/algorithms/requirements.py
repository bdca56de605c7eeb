"""What the builders read from an environment, checked before anything is built."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import NestedKey
from torchrl.data import Binary, Bounded, Categorical, MultiCategorical, MultiOneHot, OneHot, TensorSpec
from torchrl.envs import EnvBase, GymWrapper
from torchrl.envs.transforms import TransformedEnv

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs import Task, task_of
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
        num_subgoals: G; 0 for a flat agent.
        hazard_key, available_key: entries that not every environment has, or ``None``.
        task: what the environment states.
    """

    num_envs: int
    observation: TensorSpec
    num_actions: int
    num_subgoals: int
    hazard_key: NestedKey | None
    available_key: NestedKey | None
    task: Task

    @property
    def hazard_keys(self) -> list[NestedKey]:
        """The hazard's entry, if there is one."""
        return [] if self.hazard_key is None else [self.hazard_key]


def check_environment(env: EnvBase, architecture: Architecture, *, builder: str, subgoals: bool) -> Requirements:
    """Reads the specs of an environment.

    Args:
        env: bare environment.
        architecture: what reads the observation.
        builder: in whose name is complained.
        subgoals: whether there is more than one level.

    Raises:
        ValueError: naming everything that is missing or wrong, and what the environment has.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> needs = check_environment(MultiGoalGridEnv(4), compact_network(), builder="make_v3", subgoals=True)
        >>> needs.num_actions, needs.num_subgoals
        (4, 2)
    """
    entries = Entries.of(env)
    _check_batch(entries)
    _check_resets(env, entries)
    _check_observation(entries, architecture)
    _check_action(entries)
    for key in (keys.DONE, keys.TERMINATED):
        entries.require_flags(key)
    entries.require_number(keys.REWARD)
    if subgoals:
        entries.require_flags(keys.ATTAINED, None)
        entries.require_number(keys.EXTRINSIC_REWARD)
    num_subgoals = entries.specs[keys.ATTAINED].shape[-1] if subgoals and keys.ATTAINED in entries else 0
    optional = {keys.HAZARD: 1, keys.AVAILABLE: num_subgoals} if subgoals else {}
    present = {key: size for key, size in {**optional, keys.SUCCESS: 1}.items() if key in entries}
    for key, size in present.items():
        entries.require_flags(key, size)
    entries.check(builder)
    return Requirements(
        num_envs=env.batch_size[0],
        observation=entries.specs[keys.OBSERVATION],
        num_actions=entries.specs[keys.ACTION].n,
        num_subgoals=num_subgoals,
        hazard_key=keys.HAZARD if keys.HAZARD in present else None,
        available_key=keys.AVAILABLE if keys.AVAILABLE in present else None,
        task=task_of(env),
    )


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
