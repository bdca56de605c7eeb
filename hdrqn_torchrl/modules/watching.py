"""Policies that act write the Q-values they chose by, while someone watches."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from torch import nn


@contextmanager
def writing_values(policy: nn.Module) -> Iterator[None]:
    """Sets ``writes_values`` of all parts of a policy that have such a switch, and sets it back.

    Args:
        policy: of any number of levels.

    Examples:
        >>> from hdrqn_torchrl.modules import FullyConnectedFeatures, MetaController, QNetwork
        >>> meta = MetaController(QNetwork(FullyConnectedFeatures(8, (8,)), num_actions=2, hidden_size=8))
        >>> with writing_values(meta):
        ...     meta.writes_values
        True
        >>> meta.writes_values
        False
    """
    kept = {part: part.writes_values for part in policy.modules() if hasattr(part, "writes_values")}
    try:
        for part in kept:
            part.writes_values = True  # type: ignore[assignment]
        yield
    finally:
        for part, value in kept.items():
            part.writes_values = value
