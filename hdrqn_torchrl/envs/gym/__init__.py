"""Gymnasium: importing this part registers ``hdrqn/Gridworld-v0``, ``FourRooms-v0`` and ``NineRooms-v0``."""

from hdrqn_torchrl.envs.gym.grid import MultiGoalGymEnv

__all__ = ["MultiGoalGymEnv"]
