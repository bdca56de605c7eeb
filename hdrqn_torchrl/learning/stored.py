"""Checks that a stored state can be that of a learner, before anything is loaded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import NestedKey
from tensordict.utils import unravel_key

from hdrqn_torchrl.learning.settings import LearnerSettings


def check_counters(state: Mapping[str, Any], settings: LearnerSettings) -> None:
    """Refuses counts that no training has: an update would be made for each one that is missing.

    Args:
        state: what a learner's ``state_dict`` returned.
        settings: of the learner that is to load it.

    Raises:
        ValueError: naming the count.
    """
    for name in ("updates", "frames", "warm_at"):
        value = state[name]
        if not isinstance(value, int) or not 0 <= value < 2**53:
            raise ValueError(
                f"the stored learner's {name} must be a whole number in [0, 2**53), got {value!r}; it is damaged: use "
                "another checkpoint."
            )
    owed = state["frames"] - state["warm_at"] - state["updates"] * settings.frames_per_update
    if owed > max(settings.capacity, 1_000_000):
        raise ValueError(
            f"the stored learner's updates must make up for its frames, got {state['updates']} for "
            f"{state['frames']}; load it with the frames_per_update that it was saved with, or use another one."
        )


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
