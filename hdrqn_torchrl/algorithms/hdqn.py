"""hDQN: the levels of :mod:`~hdrqn_torchrl.algorithms.hierarchical` without memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from torchrl.envs import EnvBase

from hdrqn_torchrl.algorithms import presets
from hdrqn_torchrl.algorithms.base import Algorithm
from hdrqn_torchrl.algorithms.hierarchical import make_hdrqn
from hdrqn_torchrl.discovery import DiscoverySettings
from hdrqn_torchrl.learning import LearnerSettings, PhaseOne
from hdrqn_torchrl.modules import Architecture, EpsilonGreedy


def make_hdqn(
    env: EnvBase,
    architecture: Architecture,
    *,
    levels: int = 2,
    subgoals: Literal["given", "discovered"] = "given",
    discovery: DiscoverySettings = DiscoverySettings(),  # noqa: B008 (frozen)
    total_frames: int | None = None,
    sub: LearnerSettings = presets.HDQN_SUB_LEARNER,
    meta: LearnerSettings = presets.META_LEARNER,
    middle: LearnerSettings | None = None,
    sub_exploration: EpsilonGreedy | None = None,
    meta_exploration: EpsilonGreedy | None = None,
    middle_exploration: EpsilonGreedy | None = None,
    phase_one: PhaseOne | None = None,
    gamma: float = 0.99,
    smdp_discount: bool = True,
    mask_reached: bool = True,
    repeatable_subgoals: bool | None = None,
    wrong_subgoal_reward: float | Sequence[float] = 0.0,
    hazard_reward: float = -1.0,
    max_option_steps: int | None = None,
    sub_hindsight: bool = False,
    meta_hindsight: bool = False,
) -> Algorithm:
    """Levels without memory, which read the observation (h-DQN; Kulkarni et al., 2016).

    Args:
        env, architecture, levels, subgoals, discovery, total_frames, sub, meta, middle: as in :func:`make_hdrqn`.
        sub_exploration, meta_exploration, middle_exploration, phase_one: as in :func:`make_hdrqn`.
        gamma, smdp_discount, mask_reached, repeatable_subgoals: as in :func:`make_hdrqn`.
        wrong_subgoal_reward, hazard_reward, max_option_steps: as in :func:`make_hdrqn`.
        sub_hindsight, meta_hindsight: as in :func:`make_hdrqn`.

    Raises:
        ValueError: as :func:`make_hdrqn`.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> list(make_hdqn(MultiGoalGridEnv(num_envs=4), compact_network()).learners)
        ['sub', 'meta']
    """
    return make_hdrqn(
        env,
        architecture,
        version="v1",
        levels=levels,
        subgoals=subgoals,
        discovery=discovery,
        total_frames=total_frames,
        sub=sub,
        meta=meta,
        middle=middle,
        sub_exploration=sub_exploration,
        meta_exploration=meta_exploration,
        middle_exploration=middle_exploration,
        phase_one=phase_one,
        gamma=gamma,
        smdp_discount=smdp_discount,
        mask_reached=mask_reached,
        repeatable_subgoals=repeatable_subgoals,
        wrong_subgoal_reward=wrong_subgoal_reward,
        hazard_reward=hazard_reward,
        max_option_steps=max_option_steps,
        sub_hindsight=sub_hindsight,
        meta_hindsight=meta_hindsight,
        recurrent=False,
    )
