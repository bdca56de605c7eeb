"""Checks whether an environment fulfils the contract for tasks, by stepping it; says what each fault or gap costs."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from copy import deepcopy
from itertools import pairwise

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical
from torchrl.envs import EnvBase, GymWrapper, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.check_choices import check_masks, check_observation, check_shapes, check_values, random_actions
from hdrqn_torchrl.envs.findings import Finding, ReturnError, missing, wrong
from hdrqn_torchrl.envs.observations import ProblemOf
from hdrqn_torchrl.envs.specs import check_is_environment
from hdrqn_torchrl.envs.subgoals import SubgoalSet
from hdrqn_torchrl.envs.task import Task, task_of
from hdrqn_torchrl.random_numbers import own_random_numbers

Rollout = list[TensorDictBase]  # one [N] for each step, its outcome below "next"
_TOLERANCE = 1e-4  # of sums of rewards
_GO_ON = 20  # steps after a restored state


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
                found += _behaviour(env, task, steps, seed)
            except ReturnError as error:
                found.append(wrong(str(error), "training stops there"))
    return sorted(dict.fromkeys(found), key=lambda finding: finding.severity != "wrong")


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


def _behaviour(env: EnvBase, task: Task, steps: int, seed: int) -> list[Finding]:
    """Faults that show when it is stepped."""
    first, again, other = (_rollout(env, steps, each, seed) for each in (seed, seed, seed + 1))
    found = list(check_shapes(env, first[0])) or list(
        check_values(first + other, env.observation_spec[keys.OBSERVATION])
    )
    if found:
        return found
    for rollout in (first, other):
        found += [*_ends(rollout, task), *_paid(rollout), *_returns(rollout, task), *check_masks(rollout)]
        for each in _sets(env, task):
            found += _attained(rollout, each)
    return [*found, *_seeds(first, again, other), *_round_trip(env)]


def _rollout(env: EnvBase, steps: int, seed: int, actions_seed: int) -> Rollout:
    """The same actions from any seed."""
    env.set_seed(seed)
    torch.manual_seed(actions_seed)
    return _go_on(env, env.reset(), steps)


def _go_on(env: EnvBase, tensordict: TensorDictBase, steps: int) -> Rollout:
    rollout = []
    for _ in range(steps):
        step, tensordict = env.step_and_maybe_reset(random_actions(env, tensordict))
        rollout.append(step.clone())
    return rollout


def _column(rollout: Rollout, key: str) -> Tensor:
    """What was written under a key after each step, ``[T, N]``."""
    return torch.stack([step["next", key].squeeze(-1) for step in rollout])


def _ends(rollout: Rollout, task: Task) -> Iterator[Finding]:
    done, over = _column(rollout, keys.DONE), _column(rollout, keys.TERMINATED)
    if keys.TRUNCATED in rollout[0]["next"]:
        over = over | _column(rollout, keys.TRUNCATED)
    if (done != over).any():
        yield wrong("'done' must be 'terminated' or 'truncated', and is not", "values are bootstrapped wrongly")
    longest = task.max_steps
    length = torch.zeros(done.shape[1], dtype=torch.int64)
    for ended in done.cpu():
        length += 1
        if longest is not None and (length >= longest).logical_and(~ended).any():
            yield wrong(f"an episode went on after max_steps={longest}", "evaluations fail, v3 misses its end")
            return
        length[ended] = 0


def _paid(rollout: Rollout) -> Iterator[Finding]:
    """Whether rewards are paid in steps that agents learn from."""
    if keys.TRUNCATED not in rollout[0]["next"]:
        return
    cut = _column(rollout, keys.TRUNCATED) & ~_column(rollout, keys.TERMINATED)
    paid = _column(rollout, keys.REWARD).abs()
    if (paid[cut] > 0).sum() > 1 and paid[cut].sum() > paid[~cut].sum():
        text = "most of the reward is paid in steps that are 'truncated', of which agents learn nothing"
        yield wrong(text, "it is not learned; end episodes by 'terminated' where their task ends")


def _returns(rollout: Rollout, task: Task) -> Iterator[Finding]:
    """Whether the sums of whole episodes keep the bounds that are stated."""
    bounds = {
        keys.REWARD: (-float("inf"), task.largest_return),
        keys.EXTRINSIC_REWARD: (task.smallest_extrinsic_return, task.largest_extrinsic_return),
    }
    done = _column(rollout, keys.DONE)
    for key, (least, most) in bounds.items():
        if key not in rollout[0]["next"]:
            continue
        rewards = _column(rollout, key)
        if not rewards.isfinite().all():
            yield wrong(f"{key!r} must be finite, and is not", "training stops")
            return
        total, whole = torch.zeros_like(rewards[0]), torch.zeros_like(done[0])
        for reward, ended in zip(rewards.flip(0), done.flip(0), strict=True):
            whole = whole | ended
            total = reward + torch.where(ended, 0.0, total)
            if (whole & ((total > most + _TOLERANCE) | (total < least - _TOLERANCE))).any():
                text = f"the sum of {key!r} must lie in [{least:g}, {most:g}] as the task says, and does not"
                yield wrong(text, "targets are cut off at the wrong bound")
                return


def _attained(rollout: Rollout, subgoals: SubgoalSet) -> Iterator[Finding]:
    """Whether a subgoal is attained in the step that attains it, and then not again."""
    key = subgoals.keys.attained
    if key not in rollout[0]["next"]:
        return
    before: Tensor | None = None
    for step in rollout:
        now, done = step["next", key], step["next", keys.DONE]
        if before is not None and (now & before).any():
            if subgoals.repeatable:
                text = f"{key!r} must be true only in the step that attains a subgoal, and is true in the next one, too"
                yield wrong(text, "the reward for one subgoal is paid many times")
            else:
                text = (
                    f"{key!r} must be true once in an episode for each subgoal, as they are not repeatable, and is not"
                )
                yield wrong(text, "subgoals that are left are not chosen; or the reward is paid many times")
            return
        kept = now if subgoals.repeatable or before is None else now | before
        before = kept & ~done


def _seeds(first: Rollout, again: Rollout, other: Rollout) -> Iterator[Finding]:
    if not _same(first, again):
        yield wrong("the same seed must give the same worlds, and does not", "evaluations can't be repeated")
    elif _same(first, other) and _is_random(first):
        yield wrong("another seed must give other worlds, and does not", "all seeds of a study are one")


_COMPARED = (keys.OBSERVATION, ("next", keys.OBSERVATION), ("next", keys.REWARD), ("next", keys.DONE))


def _same(first: Rollout, second: Rollout, entries: Sequence[NestedKey] = _COMPARED) -> bool:
    pairs = zip(first, second, strict=True)
    return all(bool((one[key] == two[key]).all()) for one, two in pairs for key in entries if key in one)


def _written(rollout: Rollout) -> list[NestedKey]:
    """All flags that a step writes: subgoals, success, what can be chosen."""
    after = rollout[0]["next"]
    return [("next", key) for key, value in after.items() if isinstance(value, Tensor) and value.dtype == torch.bool]


def _is_random(rollout: Rollout) -> bool:
    """Whether episodes or worlds begin differently."""
    starts = [rollout[0][keys.OBSERVATION]]
    for step, following in pairwise(rollout):
        starts.append(following[keys.OBSERVATION][step["next", keys.DONE].squeeze(-1)])
    worlds = torch.cat(starts)
    return bool((worlds != worlds[:1]).any())


def _round_trip(env: EnvBase) -> Iterator[Finding]:
    """Whether an environment goes on from a stored state as it would have."""
    base = getattr(env, "base_env", env)
    tensordict = env.step_and_maybe_reset(random_actions(env, env.reset()))[1]
    state = deepcopy(base.state_dict())
    if not state:
        yield missing("state_dict() returns nothing", "no resume: a training that was stopped starts from scratch")
        return
    rollouts = []
    for _ in range(2):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            base.load_state_dict(deepcopy(state))
        if told:
            yield missing(str(told[0].message), "no resume bit for bit")
            return
        with own_random_numbers(0):
            rollouts.append(_go_on(env, tensordict.clone(), _GO_ON))
    if not _same(rollouts[0], rollouts[1], (*_COMPARED, *_written(rollouts[0]))):
        yield wrong(
            "state_dict() must hold the whole state with random numbers, and does not", "resumed trainings differ"
        )
