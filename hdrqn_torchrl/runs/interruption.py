"""Stop requests by signal: training ends at the next safe point instead of anywhere."""

from __future__ import annotations

import signal
import threading
import time
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """Training stopped on request, after saving itself.

    Args:
        number: the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.number = number

    @property
    def exit_code(self) -> int:
        """What a shell reports for a process that this signal ended: 130 for SIGINT, 143 for SIGTERM."""
        return 128 + self.number


class StopRequest:
    """Remembers a SIGINT or SIGTERM until :meth:`check` is called; a second one, later than a second
    after the first, is a KeyboardInterrupt at once.

    It can be entered again inside: whoever enters it first hears of the signals.

    Examples:
        >>> with StopRequest() as stop:
        ...     stop.check()  # nobody asked
        ...     signal.raise_signal(signal.SIGTERM)
        ...     try:
        ...         stop.check()
        ...     except Interrupted as reason:
        ...         print(reason.exit_code)
        143
    """

    def __init__(self) -> None:
        self._requested: int | None = None
        self._requested_at = 0.0
        self._depth = 0
        self._former: dict[int, object] = {}

    def __enter__(self) -> StopRequest:
        self._depth += 1
        if self._depth > 1:
            return self
        self._requested = None
        if threading.current_thread() is threading.main_thread():  # Python allows handlers nowhere else
            self._former = {number: signal.signal(number, self._handle) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if self._depth:
            return
        for number, handler in self._former.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._former = {}

    def _handle(self, number: int, _: FrameType | None) -> None:
        now = time.monotonic()
        if self._requested is not None:
            if now - self._requested_at < 1.0:
                return  # the same request: a terminal and a parent process both pass it on
            raise KeyboardInterrupt
        self._requested, self._requested_at = number, now

    def check(self) -> None:
        """Raises :class:`Interrupted` if a stop was asked for."""
        if self._requested is not None:
            raise Interrupted(self._requested)
