"""Losses and the pure target functions beneath them."""

from hdrqn_torchrl.objectives.recurrent_dqn import RecurrentDQNLoss
from hdrqn_torchrl.objectives.targets import double_q_value, smdp_target, training_mask

__all__ = ["RecurrentDQNLoss", "double_q_value", "smdp_target", "training_mask"]
