"""Environments, the scripted players that mark their ceilings, and their Gymnasium twins."""

from hdrqn_torchrl.envs.gridworld import MultiGoalGridEnv

__all__ = ["MultiGoalGridEnv"]
