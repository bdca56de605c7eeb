"""A short recording out of a long one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from hdrqn_torchrl.rendering.frames import Frame


def excerpt(frames: Sequence[Frame], most: int) -> list[Frame]:
    """The first episodes of a recording, whole, as far as there is room for them.

    Of a first episode that is longer, every n-th moment and its end are left.

    Args:
        frames: what :func:`~hdrqn_torchrl.rendering.record_episodes` returned, at least one.
        most: number of frames that there is room for; a beginning and an end are there in any case.

    Examples:
        >>> from hdrqn_torchrl.algorithms import make_hdrqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> from hdrqn_torchrl.rendering import record_episodes
        >>> env = MultiGoalGridEnv(num_envs=1, max_steps=3)
        >>> agent = make_hdrqn(env, compact_network(8, (8,)))
        >>> frames = record_episodes(agent.transform(env), agent, episodes=3)
        >>> len(frames), len(excerpt(frames, most=10))
        (12, 8)
    """
    ends = [place + 1 for place, frame in enumerate(frames) if frame.outcome] or [len(frames)]
    fitting = [end for end in ends if end <= most]
    if not fitting:
        stride = -(-(ends[0] - 1) // max(most - 1, 1))
        return [replace(frame, episodes=1) for frame in (*frames[: ends[0] - 1 : stride], frames[ends[0] - 1])]
    return [replace(frame, episodes=len(fitting)) for frame in frames[: fitting[-1]]]
