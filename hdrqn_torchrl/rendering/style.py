"""Colours and letters of pictures."""

from hdrqn_torchrl.envs.scene import Colour, font

__all__ = ["Colour", "font"]
