"""What shows of the contract for tasks when an environment is stepped: ends, rewards, subgoals, seeds, states."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from copy import deepcopy
from itertools import pairwise

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.check_choices import check_masks, check_shapes, check_values, random_actions
from hdrqn_torchrl.envs.findings import Finding, missing, wrong
from hdrqn_torchrl.envs.subgoals import SubgoalSet
from hdrqn_torchrl.envs.task import Task
from hdrqn_torchrl.random_numbers import own_random_numbers

Rollout = list[TensorDictBase]  # one [N] for each step, its outcome below "next"
_TOLERANCE = 1e-4  # of sums of rewards
_GO_ON = 20  # steps after a restored state


def check_behaviour(env: EnvBase, task: Task, sets: Sequence[SubgoalSet], *, steps: int, seed: int) -> list[Finding]:
    """Faults that show when an environment is stepped.

    Args:
        env: whose specs are as agents need them.
        task: what it states.
        sets: of subgoals, stated or not.
        steps: of each rollout.
        seed: the first of two.
    """
    first, again, other = (_rollout(env, steps, each, seed) for each in (seed, seed, seed + 1))
    for step in first + other:
        if found := list(check_shapes(env, step)):
            return found
    if found := list(check_values(first + other, env.observation_spec[keys.OBSERVATION])):
        return found
    for rollout in (first, other):
        found += [*_ends(rollout, task), *_paid(rollout), *_returns(rollout, task), *check_masks(rollout)]
        for each in sets:
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
        text = "most of the reward is paid in steps that are 'truncated', of which v3 and sub levels learn nothing"
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
