"""Losses and the pure target functions beneath them."""

from hdrqn_torchrl.objectives.all_subgoals import AllSubgoalsLoss
from hdrqn_torchrl.objectives.base import SequenceLoss
from hdrqn_torchrl.objectives.recurrent_dqn import RecurrentDQNLoss
from hdrqn_torchrl.objectives.targets import (
    check_returns,
    double_q_value,
    greedy_choice,
    importance_weight,
    lambda_returns,
    n_step_returns,
    sequence_priority,
    smdp_target,
    target_lookahead,
    training_mask,
    watkins_trace,
)

__all__ = [
    "AllSubgoalsLoss",
    "RecurrentDQNLoss",
    "SequenceLoss",
    "check_returns",
    "double_q_value",
    "greedy_choice",
    "importance_weight",
    "lambda_returns",
    "n_step_returns",
    "sequence_priority",
    "smdp_target",
    "target_lookahead",
    "training_mask",
    "watkins_trace",
]
