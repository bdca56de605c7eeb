"""Gymnasium: importing this part registers ``hdrqn/Gridworld-v0`` and ``hdrqn/FourRooms-v0``."""

from hdrqn_torchrl.envs.gym.grid import MultiGoalGymEnv

__all__ = ["MultiGoalGymEnv"]
