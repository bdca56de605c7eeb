"""What replay memories of earlier versions hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import NestedKey
from tensordict.utils import unravel_key


def holds_inputs_twice(buffer: Mapping[str, Any], read: list[NestedKey]) -> bool:
    """Whether a stored memory has inputs under ``"next"`` that the loss does not read: earlier versions kept them.

    Args:
        buffer: state of the memory.
        read: ``in_keys`` of the loss.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> seen = torch.zeros(3)
        >>> steps = TensorDict(observation=seen, next=TensorDict(observation=seen, batch_size=3), batch_size=3)
        >>> holds_inputs_twice({"_storage": {"stored": steps}}, ["observation"])
        True
    """
    stored = buffer["_storage"]["stored"]
    if stored is None:
        return False
    kept, wanted = set(stored.keys(True, True)), {unravel_key(key) for key in read}
    return any((twice := unravel_key(("next", key))) in kept and twice not in wanted for key in wanted)
