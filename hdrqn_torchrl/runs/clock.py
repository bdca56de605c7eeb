"""The time that a training has taken."""

from __future__ import annotations

import time


class Clock:
    """Wall time and processor time; both stand still while the training is stopped.

    Examples:
        >>> clock = Clock()
        >>> clock.load_state_dict({"wall_seconds": 60.0, "processor_seconds": 50.0})
        >>> clock.wall_seconds >= 60 and clock.processor_seconds >= 50
        True
    """

    def __init__(self) -> None:
        self.load_state_dict({"wall_seconds": 0.0})

    @property
    def wall_seconds(self) -> float:
        """Seconds of training."""
        return time.monotonic() - self._wall_began

    @property
    def processor_seconds(self) -> float:
        """Processor time of the process meanwhile, all its threads together; that of workers is not in it."""
        return time.process_time() - self._processor_began

    def state_dict(self) -> dict[str, float]:
        """Both times so far."""
        return {"wall_seconds": self.wall_seconds, "processor_seconds": self.processor_seconds}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Goes on from these times; earlier versions did not store processor time, which then begins at 0."""
        self._wall_began = time.monotonic() - state["wall_seconds"]
        self._processor_began = time.process_time() - state.get("processor_seconds", 0.0)
