"""Environments, the scripted players that mark their ceilings, and their Gymnasium twins."""

from hdrqn_torchrl.envs.ceilings import ceiling
from hdrqn_torchrl.envs.gridworld import MultiGoalGridEnv
from hdrqn_torchrl.envs.montezuma import MontezumaEnv, make_montezuma
from hdrqn_torchrl.envs.scripted import (
    EgocentricSearch,
    FullInformationPlanner,
    PerfectMemorySearch,
    UniformRandom,
    play_episodes,
    scripted_ceiling,
)
from hdrqn_torchrl.envs.task import GoalsInOrder, Task, task_of

__all__ = [
    "EgocentricSearch",
    "FullInformationPlanner",
    "GoalsInOrder",
    "MontezumaEnv",
    "MultiGoalGridEnv",
    "PerfectMemorySearch",
    "Task",
    "UniformRandom",
    "ceiling",
    "make_montezuma",
    "play_episodes",
    "scripted_ceiling",
    "task_of",
]
