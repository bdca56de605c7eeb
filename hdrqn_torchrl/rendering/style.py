"""Colours and fonts of pictures."""

from hdrqn_torchrl.envs.scene import Colour, font

__all__ = ["Colour", "font"]
