"""DQN, DRQN, hDQN, hDRQNv1, hDRQNv2 and hDRQNv3 as pure builders over the same parts.

A builder reads the specs of a bare environment and returns an :class:`Algorithm`: a policy, one learner per
level, and the transforms that the environment needs. The training loop never asks which one it runs.
"""

from hdrqn_torchrl.algorithms.base import Algorithm, make_recurrent_loss
from hdrqn_torchrl.algorithms.flat import make_dqn, make_drqn
from hdrqn_torchrl.algorithms.hdqn import make_hdqn
from hdrqn_torchrl.algorithms.hierarchical import make_hdrqn
from hdrqn_torchrl.algorithms.levels import Level
from hdrqn_torchrl.algorithms.presets import V3_LEARNER
from hdrqn_torchrl.algorithms.v3 import make_v3
from hdrqn_torchrl.algorithms.views import LevelView

__all__ = [
    "V3_LEARNER",
    "Algorithm",
    "Level",
    "LevelView",
    "make_dqn",
    "make_drqn",
    "make_hdqn",
    "make_hdrqn",
    "make_recurrent_loss",
    "make_v3",
]
