"""TorchRL transforms: the option book."""

from hdrqn_torchrl.transforms.subgoal import SubgoalTransform, advance_option, intrinsic_reward

__all__ = ["SubgoalTransform", "advance_option", "intrinsic_reward"]
