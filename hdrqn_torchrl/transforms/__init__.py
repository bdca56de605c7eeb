"""TorchRL transforms: the option book."""

from hdrqn_torchrl.transforms.subgoal import SubgoalTransform

__all__ = ["SubgoalTransform"]
