"""Gymnasium: any environment as a task, and twins of grids (``hdrqn/Gridworld-v0``, ``FourRooms-v0``, ...)."""

from hdrqn_torchrl.envs.gym.environment import GymTaskEnv
from hdrqn_torchrl.envs.gym.grid import MultiGoalGymEnv
from hdrqn_torchrl.envs.gym.making import make_gym
from hdrqn_torchrl.envs.gym.observations import Encoder, make_encoder
from hdrqn_torchrl.envs.gym.subgoals import Subgoals

__all__ = ["Encoder", "GymTaskEnv", "MultiGoalGymEnv", "Subgoals", "make_encoder", "make_gym"]
