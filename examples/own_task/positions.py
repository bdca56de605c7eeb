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
    """CartPole's two positions, without the two velocities between them."""
    space = env.observation_space
    assert isinstance(space, Box)
    seen = Box(space.low[_POSITIONS], space.high[_POSITIONS], dtype=np.float32)
    return TransformObservation(env, lambda observation: observation[_POSITIONS], seen)
