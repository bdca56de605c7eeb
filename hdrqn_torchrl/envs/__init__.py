"""Environments, the scripted players that mark their ceilings, and their Gymnasium twins."""

from hdrqn_torchrl.envs.check import check_task
from hdrqn_torchrl.envs.findings import Finding
from hdrqn_torchrl.envs.grid.ceilings import ceiling
from hdrqn_torchrl.envs.grid.environment import MultiGoalGridEnv
from hdrqn_torchrl.envs.grid.scripted import (
    EgocentricSearch,
    FullInformationPlanner,
    PerfectMemorySearch,
    UniformRandom,
    play_episodes,
    scripted_ceiling,
)
from hdrqn_torchrl.envs.gym.making import make_gym
from hdrqn_torchrl.envs.gym.minigrid.making import make_minigrid
from hdrqn_torchrl.envs.gym.subgoals import Subgoals
from hdrqn_torchrl.envs.montezuma.environment import MontezumaEnv
from hdrqn_torchrl.envs.montezuma.making import make_montezuma
from hdrqn_torchrl.envs.subgoals import SubgoalSet
from hdrqn_torchrl.envs.symmetry import Symmetry
from hdrqn_torchrl.envs.task import Reference, Task, task_of

__all__ = [
    "EgocentricSearch",
    "Finding",
    "FullInformationPlanner",
    "MontezumaEnv",
    "MultiGoalGridEnv",
    "PerfectMemorySearch",
    "Reference",
    "SubgoalSet",
    "Subgoals",
    "Symmetry",
    "Task",
    "UniformRandom",
    "ceiling",
    "check_task",
    "make_gym",
    "make_minigrid",
    "make_montezuma",
    "play_episodes",
    "scripted_ceiling",
    "task_of",
]
