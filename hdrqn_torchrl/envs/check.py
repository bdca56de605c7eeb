"""Checks whether an environment fulfils the contract for tasks, by stepping it; says what each fault or gap costs."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from pathlib import Path

import torch
from torchrl.data import Categorical
from torchrl.envs import EnvBase, GymWrapper, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.check_behaviour import check_behaviour
from hdrqn_torchrl.envs.check_choices import check_observation
from hdrqn_torchrl.envs.findings import Finding, ReturnError, missing, wrong
from hdrqn_torchrl.envs.observations import ProblemOf
from hdrqn_torchrl.envs.specs import check_is_environment
from hdrqn_torchrl.envs.subgoals import SubgoalSet
from hdrqn_torchrl.envs.task import Task, task_of
from hdrqn_torchrl.random_numbers import own_random_numbers


def check_task(
    env: EnvBase, *, steps: int = 300, seed: int = 0, network_problem: ProblemOf | None = None
) -> list[Finding]:
    """Steps an environment with random actions, from two seeds, and compares it with the contract for tasks.

    What random actions do not reach is not checked: the end of an episode, say, or a subgoal.

    Args:
        env: with batch size ``[N]``, without an agent's own transforms; it is reset, so its worlds are lost.
        steps: of each rollout.
        seed: the first one.
        network_problem: ``observation_problem`` of the network that is to read the observation: what it can't read is
            wrong. ``None``: what built-in networks can't read is missing, as others may read it.

    Returns:
        What is wrong first, then what is missing; empty if nothing is.

    Raises:
        ValueError: if ``env`` is no environment, or ``steps`` is below 1.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> check_task(MultiGoalGridEnv(4))
        []
    """
    check_is_environment(env)
    if steps < 1:
        raise ValueError(f"steps must be >= 1, got {steps}; 300 show most faults.")
    task = task_of(env)
    found = [*_entries(env, task), *check_observation(env, network_problem), *_statement(env, task)]
    if not any(finding.severity == "wrong" for finding in found):  # else it can't be stepped as agents do
        with own_random_numbers(seed):
            try:
                found += check_behaviour(env, task, _sets(env, task), steps=steps, seed=seed)
            except ReturnError as error:
                found.append(wrong(str(error), "training stops there"))
            except Exception as error:  # whatever the environment raises
                found.append(wrong(_raised(error), "training stops there"))
    return sorted(dict.fromkeys(found), key=lambda finding: finding.severity != "wrong")


def _raised(error: Exception) -> str:
    """What an environment raised, and where; errors of this package say all themselves."""
    *_, (frame, line) = traceback.walk_tb(error.__traceback__)
    place = Path(frame.f_code.co_filename)
    if isinstance(error, ValueError) and place.is_relative_to(Path(__file__).parents[1]):
        return str(error)
    return f"stepping it raised {type(error).__name__}: {error} ({place}:{line})"


def _sets(env: EnvBase, task: Task) -> tuple[SubgoalSet, ...]:
    """The sets of subgoals that the task states, or the one that its entry ``attained`` implies."""
    spec = env.observation_spec.get(keys.ATTAINED, None)
    if task.subgoals or spec is None or spec.ndim != 2 or not spec.shape[-1]:
        return task.subgoals
    return (SubgoalSet(names=tuple(map(str, range(spec.shape[-1])))),)


def _entries(env: EnvBase, task: Task) -> Iterator[Finding]:
    """Faults of the specs."""
    if len(env.batch_size) != 1:
        yield wrong(f"the batch size must be [N], got {list(env.batch_size)}", "no agent can be made for it")
        return
    specs = {**dict(env.observation_spec.items()), **dict(env.full_reward_spec.items())}
    specs |= dict(env.full_done_spec.items())
    action = env.full_action_spec.get(keys.ACTION, None)
    if not (type(action) is Categorical and action.shape == env.batch_size):
        yield wrong("'action' must be one number [N], a Categorical", "no agent can be made for it")
    if keys.OBSERVATION not in specs:
        yield wrong("'observation' is missing", "no agent can be made for it")
    wanted = {keys.REWARD: 1, keys.EXTRINSIC_REWARD: 1, keys.HAZARD: 1, task.success: 1}
    wanted |= {keys.DONE: 1, keys.TERMINATED: 1, keys.TRUNCATED: 1}
    for each in _sets(env, task):
        wanted |= {each.keys.attained: len(each), each.keys.available: len(each)}
    if isinstance(action, Categorical):
        wanted[keys.ACTION_MASK] = action.n
    for key, size in wanted.items():
        kind = torch.float32 if key in (keys.REWARD, keys.EXTRINSIC_REWARD) else torch.bool
        if (spec := specs.get(key)) is None:
            continue
        if (list(spec.shape), spec.dtype) != ([*env.batch_size, size], kind):
            text = f"{key!r} must be {kind} {[*env.batch_size, size]}, got {spec.dtype} {list(spec.shape)}"
            yield wrong(text, "agents that read it can't be made")
    for key in (keys.REWARD, keys.DONE, keys.TERMINATED):
        if key not in specs:
            yield wrong(f"{key!r} is missing", "no agent can be made for it")
    for each in task.subgoals:
        if each.keys.attained not in specs:
            yield wrong(f"{each.keys.attained!r} is missing, though its subgoals are stated", "no agent pursues them")
    yield from _optional(specs, task)


def _optional(specs: dict, task: Task) -> Iterator[Finding]:
    """Entries that not every agent needs."""
    if not task.subgoals and keys.ATTAINED not in specs:
        yield missing("'attained' is missing", "agents of one level only")
    elif keys.EXTRINSIC_REWARD not in specs:
        yield missing("'extrinsic_reward' is missing", "agents of one level only")
    if keys.HAZARD not in specs:
        yield missing("'hazard' is missing", "no penalty for hazards")
    if task.success not in specs:
        yield missing(f"{task.success!r} is missing", "no success rate")


def _statement(env: EnvBase, task: Task) -> Iterator[Finding]:
    """What the task states wrongly or leaves unstated."""
    if (stated := _other_statement(env)) is not None:
        yield wrong(f"'task' must be a Task, got {stated!r}", "what it states is not read")
    action = env.full_action_spec.get(keys.ACTION, None)
    if isinstance(action, Categorical) and task.actions and len(task.actions) != action.n:
        text = f"the task must name {action.n} actions, or none, and names {len(task.actions)}"
        yield wrong(text, "watch.py shows the wrong ones")
    if task.max_steps is None:
        yield missing("the length of episodes is unknown", "evaluations need max_steps, v3 needs slice_len")
    if task.largest_return == float("inf") or task.largest_extrinsic_return == float("inf"):
        yield missing(
            "the largest returns are unknown", "targets are not bounded, and a resume does not notice other rewards"
        )
    if not task.subgoals and keys.ATTAINED in env.observation_spec.keys():  # noqa: SIM118 (a spec)
        yield missing("the subgoals are not stated", "they have no names, and there is no third level")
    if not task.actions:
        yield missing("the actions have no names", "watch.py numbers them")
    if not task.references:
        yield missing("there are no scripted players", "no ceiling line")
    if task.scene is None and not callable(getattr(type(env), "render", None)):
        yield missing("there is neither a scene nor a method render", "watch.py shows observations as numbers")


def _other_statement(env: EnvBase) -> object:
    """An attribute ``task`` of TorchRL's own kind of environment that is no ``Task``; Gymnasium's may mean anything."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    stated = None if isinstance(env, BatchedEnvBase | GymWrapper) else getattr(env, "task", None)
    return None if isinstance(stated, Task) else stated
