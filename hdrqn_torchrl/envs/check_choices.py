"""What the check of an environment says about the observation, and about actions that can't always be chosen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from tensordict import TensorDictBase
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
