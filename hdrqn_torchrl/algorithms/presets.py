"""Default settings of every algorithm: the builders' default arguments, equal to ``conf/algo/`` (a test compares).

The settings of a level are :class:`~hdrqn_torchrl.learning.LearnerSettings`. Its own defaults are what all levels have
in common; here stands what differs. Schedules of exploration are functions, because an exploration counts frames and
every agent needs its own.

Examples:
    A training of 200,000 frames, in which the learning rate reaches its end:

    >>> from dataclasses import replace
    >>> replace(META_LEARNER, learning_rate_frames=200_000).slice_len
    1
"""

from __future__ import annotations

from dataclasses import replace

from hdrqn_torchrl.learning import LearnerSettings
from hdrqn_torchrl.modules import EpsilonGreedy, RepeatingEpsilonGreedy

DRQN_LEARNER = LearnerSettings()
"""DRQN's."""
DQN_LEARNER = LearnerSettings(slice_len=1, batch_size=128, learning_rate=3e-4, tau=0.01)
"""DQN's: single steps."""

SUB_LEARNER = LearnerSettings()
"""The sub level's, of hDRQNv1 and hDRQNv2."""
META_LEARNER = LearnerSettings(slice_len=1, capacity=50_000, frames_per_update=16)
"""The meta level's, of hDRQNv2 and hDQN: single options."""
V1_META_LEARNER = replace(META_LEARNER, slice_len=2)
"""The meta level's, of hDRQNv1: an observation does not show how many goals are left, but two options in a row do."""
HDQN_SUB_LEARNER = LearnerSettings(slice_len=1, batch_size=128)
"""The sub level's, of hDQN: single steps."""

V3_LEARNER = LearnerSettings(
    slice_len=None,
    capacity=200_000,
    frames_per_update=20,
    warmup_frames=10_000,
    learning_rate=6e-4,
    learning_rate_end=6e-5,
    tau=0.005,
    sampling="episode_starts",
    burn_in=0.0,
)
"""hDRQNv3's, of all levels together."""


def meta_learner(version: str) -> LearnerSettings:
    """The meta level's, of hDRQNv1 or hDRQNv2."""
    return V1_META_LEARNER if version == "v1" else META_LEARNER


def flat_exploration() -> EpsilonGreedy:
    """DQN's and DRQN's."""
    return EpsilonGreedy(1.0, 0.1, anneal_frames=100_000)


def sub_exploration() -> EpsilonGreedy:
    """The sub level's, of all hierarchies but hDRQNv3."""
    return EpsilonGreedy(1.0, 0.1, anneal_frames=100_000)


def meta_exploration() -> EpsilonGreedy:
    """The meta level's; it falls later than the sub level's, which is to learn every subgoal first."""
    return EpsilonGreedy(1.0, 0.1, anneal_frames=200_000)


def v3_sub_exploration() -> RepeatingEpsilonGreedy:
    """The sub level's, of hDRQNv3: random actions are repeated."""
    return RepeatingEpsilonGreedy(1.0, 0.03, anneal_frames=100_000, exponent=2.0, max_repeats=15)
