"""TorchRL transforms: the option book, and the window through which an agent sees a screen."""

from hdrqn_torchrl.transforms.subgoal import (
    SubgoalTransform,
    advance_option,
    intrinsic_reward,
    largest_intrinsic_return,
)
from hdrqn_torchrl.transforms.window import Window

__all__ = ["SubgoalTransform", "Window", "advance_option", "intrinsic_reward", "largest_intrinsic_return"]
