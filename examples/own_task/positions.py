"""A wrapper of your own: CartPole without velocities, which an agent has to remember to know.

python train.py env=gym env.id=CartPole-v1 'env.wrappers=[examples.own_task.positions.positions]' algo=drqn
"""

from __future__ import annotations

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import TransformObservation

_POSITIONS = [0, 2]  # of cart and pole


def positions(env: gymnasium.Env) -> gymnasium.Env:
    """CartPole's two positions without the two velocities, in units of the limits at which an episode ends."""
    world = env.unwrapped
    limits = np.array([world.x_threshold, world.theta_threshold_radians], dtype=np.float32)
    seen = Box(-2.0, 2.0, shape=(2,), dtype=np.float32)
    return TransformObservation(env, lambda observation: observation[_POSITIONS] / limits, seen)
