"""TorchRL transforms: critics, option books, and the window through which an agent sees a screen."""

from hdrqn_torchrl.transforms.critic import Critic
from hdrqn_torchrl.transforms.intrinsic import IntrinsicReward, penalties_of_sets
from hdrqn_torchrl.transforms.subgoal import SubgoalTransform, advance_option
from hdrqn_torchrl.transforms.window import Window

__all__ = ["Critic", "IntrinsicReward", "SubgoalTransform", "Window", "advance_option", "penalties_of_sets"]
