"""LSTM states in tensordicts: where sequences find theirs, and what every reset begins with."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs.transforms import TensorDictPrimer

from hdrqn_torchrl.modules.q_network import QNetwork, State


def first_state(tensordict: TensorDictBase, state_keys: Sequence[NestedKey]) -> State | None:
    """LSTM state ``[B, H]`` at the first step of sequences ``[B, T]``; ``None`` if the tensordict holds none."""
    if not state_keys or tensordict.get(state_keys[0], None) is None:
        return None
    hidden, cell = (tensordict.get(key) for key in state_keys)
    return hidden[:, 0], cell[:, 0]


def read_flag(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """A flag that an environment with an agent's transforms writes.

    Raises:
        KeyError: if it is missing.
    """
    if (flag := tensordict.get(key, None)) is None:
        raise KeyError(f"{key!r} is missing: the policy must act in agent.transform(env), which writes what it reads.")
    return flag


def state_primer(
    network: QNetwork, hidden_key: NestedKey, cell_key: NestedKey, carried: dict[NestedKey, TensorSpec]
) -> TensorDictPrimer:
    """Puts zero LSTM states, and what exploration carries, into every reset."""
    state = Unbounded(shape=(network.hidden_size,))
    return TensorDictPrimer({hidden_key: state, cell_key: state.clone(), **carried}, expand_specs=True)
