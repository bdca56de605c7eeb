"""An algorithm of your own: hDRQNv2 whose exploration prefers higher values.

Three files: this builder, what differs in ``algo/soft_v2.yaml``, and a test (``tests/test_own_algorithm.py``). Nothing
of the package is changed. From the top of a checkout::

    python train.py --config-dir examples/own_algorithm algo=soft_v2 \
        'allowed_targets=[examples.own_algorithm.soft_v2.make_soft_v2]'
"""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from hdrqn_torchrl.algorithms import Algorithm, make_hdrqn, presets
from hdrqn_torchrl.learning import LearnerSettings
from hdrqn_torchrl.modules import Architecture, EpsilonGreedy


class SoftEpsilonGreedy(EpsilonGreedy):
    """Epsilon-greedy whose random choices have probabilities proportional to exp(Q / temperature).

    Args:
        temperature: small: close to greedy; large: close to uniform.
        anneal_frames: frames until epsilon has fallen from 1.0 to 0.1.
    """

    def __init__(self, temperature: float, *, anneal_frames: int) -> None:
        super().__init__(1.0, 0.1, anneal_frames=anneal_frames)
        if temperature <= 0.0:
            raise ValueError(f"temperature must be > 0, got {temperature}; use 0.5.")
        self.temperature = temperature

    def random_choice(self, values: Tensor, mask: Tensor | None) -> Tensor:
        """A choice ``[*]`` among ``values`` ``[*, A]``, which are minus infinity where ``mask`` forbids."""
        return torch.distributions.Categorical(logits=values / self.temperature).sample()


def make_soft_v2(
    env: EnvBase,
    architecture: Architecture,
    *,
    temperature: float = 0.5,
    sub: LearnerSettings = presets.SUB_LEARNER,
    meta: LearnerSettings = presets.META_LEARNER,
    gamma: float = 0.99,
) -> Algorithm:
    """hDRQNv2 with soft exploration at both levels.

    Args:
        env: bare environment, as :func:`~hdrqn_torchrl.algorithms.make_hdrqn` needs it.
        architecture: networks.
        temperature: of both levels' random choices.
        sub, meta: how each level learns.
        gamma: discount of one step.

    Raises:
        ValueError: if ``temperature`` is not above 0, or the environment lacks something.
    """
    return make_hdrqn(
        env,
        architecture,
        version="v2",
        sub=sub,
        meta=meta,
        sub_exploration=SoftEpsilonGreedy(temperature, anneal_frames=100_000),
        meta_exploration=SoftEpsilonGreedy(temperature, anneal_frames=200_000),
        gamma=gamma,
    )
