"""MiniGrid and BabyAI: subgoals are what can be done with objects; needs the extra ``minigrid``."""

from hdrqn_torchrl.envs.gym.minigrid.making import make_minigrid

__all__ = ["make_minigrid"]
