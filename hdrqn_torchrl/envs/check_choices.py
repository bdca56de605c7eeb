"""What the check of an environment says about single entries: shapes, the observation, and actions to choose from."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from tensordict import TensorDictBase
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.findings import Finding, missing, wrong
from hdrqn_torchrl.envs.observations import ProblemOf, code_sizes, observation_kind, observation_problem

_BYTE = 256


def check_observation(env: EnvBase, network_problem: ProblemOf | None = None) -> Iterator[Finding]:
    """Whether a network, or the built-in ones, can read the observation, and whether its codes are stored as bytes."""
    spec = env.observation_spec.get(keys.OBSERVATION, None)
    if spec is None or not hasattr(spec, "dtype"):
        return
    shape = spec.shape[len(env.batch_size) :]
    if (problem := (network_problem or observation_problem)(spec, shape)) is not None:
        rule, remedy = problem
        text = f"{keys.OBSERVATION!r} is not {rule}, but {spec.dtype} {list(spec.shape)}; {remedy}"
        if network_problem is None:
            yield missing(text, "built-in networks can't read it")
        else:
            yield wrong(text, "no agent can be made for it with this network")
    elif observation_kind(spec, shape) in ("cells", "codes"):
        largest, size = max(code_sizes(spec, shape)), spec.dtype.itemsize
        if largest <= _BYTE and size > 1:
            text = f"{keys.OBSERVATION!r} holds codes below {largest} as {spec.dtype}, and not as uint8"
            yield missing(text, f"replay memories are {size} times as large")


def check_shapes(env: EnvBase, step: TensorDictBase) -> Iterator[Finding]:
    """Whether the entries are as the specs promise."""
    specs = {**dict(env.observation_spec.items(True, True)), **dict(env.full_reward_spec.items(True, True))}
    specs |= dict(env.full_done_spec.items(True, True))
    for key, spec in specs.items():
        value = step["next"].get(key, None)
        if value is None:
            yield wrong(f"{key!r} has a spec, but is not written", "agents that read it fail")
        elif (value.shape, value.dtype) != (spec.shape, spec.dtype):
            text = f"{key!r} must be {spec.dtype} {list(spec.shape)} as its spec says, got {value.dtype} "
            yield wrong(text + f"{list(value.shape)}", "agents that read it fail")


def check_values(rollout: Sequence[TensorDictBase], spec: TensorSpec, batch_dims: int = 1) -> Iterator[Finding]:
    """Whether observations are numbers, and codes below the numbers of them that their spec states."""
    values = torch.stack([each[keys.OBSERVATION] for step in rollout for each in (step, step["next"])])
    if values.is_floating_point() and not values.isfinite().all():
        yield wrong(f"{keys.OBSERVATION!r} must be finite numbers, and is not", "training stops")
        return
    shape = spec.shape[batch_dims:]
    if observation_kind(spec, shape) not in ("cells", "codes"):
        return
    codes = values.reshape(-1, math.prod(shape)).long().cpu()
    outside = (codes < 0) | (codes >= torch.tensor(code_sizes(spec, shape)))
    if outside.any():
        place = int(outside.any(0).nonzero()[0])
        size, worst = code_sizes(spec, shape)[place], int(codes[:, place][outside[:, place]][0])
        text = f"{keys.OBSERVATION!r} must be codes below {size} at entry {place} as its spec says, got {worst}"
        yield wrong(text, "a code is taken for another one's")


def random_actions(env: EnvBase, tensordict: TensorDictBase) -> TensorDictBase:
    """Chooses a random action in each environment, among those that can be chosen."""
    mask = tensordict.get(keys.ACTION_MASK, None)
    if mask is None:
        return env.rand_action(tensordict)
    lottery = torch.rand(mask.shape, device=mask.device).masked_fill(~mask, -1.0)
    return tensordict.set(keys.ACTION, lottery.argmax(-1))


def check_masks(rollout: Sequence[TensorDictBase]) -> Iterator[Finding]:
    """Whether there always is an action to choose, in steps ``[N]`` one after the other."""
    key = keys.ACTION_MASK
    if key not in rollout[0]["next"]:
        return
    if key not in rollout[0]:
        yield wrong(f"{key!r} must be written at a reset, too, and is not", "the first action of an episode fails")
        return
    if not all(step[key].any(-1).all() for step in rollout):
        text = f"{key!r} must allow at least one action, at a reset and until the episode is over, and does not"
        yield wrong(text, "an action that can't be chosen is chosen")
