"""When a level's updates are due."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


class UpdateSchedule:
    """One update for every ``frames_per_update`` frames that were seen after a warm-up.

    Args:
        warmup_frames: frames without updates at the beginning.
        frames_per_update: frames for each update; below 1: several updates for each frame.

    Examples:
        >>> schedule = UpdateSchedule(warmup_frames=100, frames_per_update=20.0)
        >>> schedule.frames = 160
        >>> schedule.due
        3
        >>> schedule.updates = 2
        >>> schedule.due, schedule.frames_owed
        (1, 20.0)
        >>> schedule.let_go()
        >>> schedule.due
        0
    """

    def __init__(self, warmup_frames: int, frames_per_update: float) -> None:
        self.warmup_frames, self.frames_per_update = warmup_frames, frames_per_update
        self.frames, self.updates = 0, 0
        self.warm_at = warmup_frames
        """Frames from which on updates are counted: more than the warm-up where some were let go."""

    @property
    def frames_owed(self) -> float:
        """Frames since the warm-up for which no updates were made."""
        return self.frames - self.warm_at - self.updates * self.frames_per_update

    @property
    def due(self) -> int:
        """How many updates are owed for the frames seen so far."""
        return max(0, int((self.frames - self.warm_at) / self.frames_per_update) - self.updates)

    def let_go(self) -> None:
        """Updates that are owed are not made up for."""
        if self.frames_owed > 0:
            self.warm_at += math.ceil(self.frames_owed)

    def warm_up_again(self) -> None:
        """Updates wait for as many frames as at the beginning."""
        done = math.ceil(self.updates * self.frames_per_update)
        self.warm_at = max(0, self.frames + self.warmup_frames - done)

    def state_dict(self) -> dict[str, int]:
        """All counts."""
        return {"updates": self.updates, "frames": self.frames, "warm_at": self.warm_at}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self.updates, self.frames, self.warm_at = (state[name] for name in ("updates", "frames", "warm_at"))

    def check(self, state: Mapping[str, Any], most_owed: int) -> None:
        """Refuses counts that no training has: an update would be made for each one that is missing.

        Args:
            state: to be loaded; may have other entries.
            most_owed: largest number of frames for which updates can be owed.

        Raises:
            ValueError: naming the count.
        """
        for name in self.state_dict():
            value = state[name]
            if not isinstance(value, int) or not 0 <= value < 2**53:
                raise ValueError(
                    f"the stored learner's {name} must be a whole number in [0, 2**53), got {value!r}; it is damaged: "
                    "use another checkpoint."
                )
        stored = UpdateSchedule(self.warmup_frames, self.frames_per_update)
        stored.load_state_dict(state)
        if stored.frames_owed > most_owed:
            raise ValueError(
                f"the stored learner's updates must make up for its frames, got {state['updates']} for "
                f"{state['frames']}; load it with the frames_per_update that it was saved with, or use another one."
            )
