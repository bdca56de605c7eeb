"""Environments, the scripted players that mark their ceilings, and their Gymnasium twins."""

from hdrqn_torchrl.envs.ceilings import ceiling
from hdrqn_torchrl.envs.gridworld import MultiGoalGridEnv
from hdrqn_torchrl.envs.scripted import (
    EgocentricSearch,
    FullInformationPlanner,
    PerfectMemorySearch,
    UniformRandom,
    play_episodes,
    scripted_ceiling,
)

__all__ = [
    "EgocentricSearch",
    "FullInformationPlanner",
    "MultiGoalGridEnv",
    "PerfectMemorySearch",
    "UniformRandom",
    "ceiling",
    "play_episodes",
    "scripted_ceiling",
]
