"""Whether a loss was built with the settings that its learner is given."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.objectives import LossModule

from hdrqn_torchrl.learning.settings import LearnerSettings

_CALLED = {
    "burn_in": "burn_in",
    "train_exact_states": "train_exact_states",
    "loss_function": "loss_function",
    "double": "double_q",
    "trace_decay": "trace_decay",
    "n_step": "n_step",
    "max_target": "max_target",
    "stored_state": "state_keys",
}
"""Settings of a loss, and what it calls them."""
_DEFAULTS = {each.name: each.default for each in fields(LearnerSettings)}


def check_loss(settings: LearnerSettings, loss: LossModule, network: TensorDictModuleBase) -> None:
    """Refuses settings that the loss was not built with: it would learn by its own.

    Settings with their default are not looked at: a loss may have other ones of its own.

    Args:
        settings: of a learner.
        loss: its loss.
        network: that it trains; ``burn_in`` means nothing to one without memory.

    Raises:
        ValueError: if they differ.

    Examples:
        >>> from hdrqn_torchrl.modules import FullyConnectedFeatures, QNetwork, SubController
        >>> from hdrqn_torchrl.objectives import RecurrentDQNLoss
        >>> network = QNetwork(FullyConnectedFeatures(3, (8,)), num_actions=2, hidden_size=8)
        >>> controller = SubController(network, subgoal_key=None, init_key="is_init")
        >>> check_loss(LearnerSettings(n_step=3), RecurrentDQNLoss(controller), controller)
        Traceback (most recent call last):
        ...
        ValueError: settings.n_step must be that of the loss, which has 1, got 3; ...
    """
    for name, its in _CALLED.items():
        asked = getattr(settings, name)
        if asked == _DEFAULTS[name] or (name == "burn_in" and not getattr(network, "state_keys", True)):
            continue
        if not hasattr(loss, its):
            raise ValueError(
                f"settings.{name} must be left at {_DEFAULTS[name]}, got {asked}: {type(loss).__name__} has no such "
                "setting."
            )
        has = getattr(loss, its)
        if _meant(name, asked) != _meant(name, has):
            raise ValueError(
                f"settings.{name} must be that of the loss, which has {_shown(name, has)}, got {asked}; build it with "
                "make_recurrent_loss(network, settings), or give both the same."
            )


def _meant(name: str, value: Any) -> Any:
    """A loss keeps states, or none; a bound that there is not is infinite."""
    if name == "max_target":
        return math.inf if value in (None, "unbounded") else value
    return bool(value) if name == "stored_state" else value


def _shown(name: str, value: Any) -> Any:
    return bool(value) if name == "stored_state" else value
