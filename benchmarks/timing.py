"""Timing in turns, in processor time: on a shared machine hardly any other measure is reliable.

Both functions run on one thread and never wait, so on an idle core processor time is wall time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median


def compare(ours: Callable[[], object], raw: Callable[[], object], *, blocks: int, seconds: float) -> dict[str, float]:
    """Times two functions in alternating blocks.

    Args:
        ours: function whose time is judged.
        raw: reference that does the same work.
        blocks: pairs of blocks; within a pair the order alternates.
        seconds: approximate length of a block in processor time.

    Returns:
        Median milliseconds of a call (``ours_ms``, ``raw_ms``) and the median over pairs of ours / raw (``ratio``).
    """
    both = (ours, raw)
    calls = [max(1, round(seconds / min(_seconds_per_call(function, 1) for _ in range(5)))) for function in both]
    times: tuple[list[float], list[float]] = ([], [])
    for block in range(blocks):
        for which in (0, 1) if block % 2 == 0 else (1, 0):
            times[which].append(_seconds_per_call(both[which], calls[which]))
    ratios = [mine / reference for mine, reference in zip(*times, strict=True)]
    return {
        "ours_ms": round(1e3 * median(times[0]), 3),
        "raw_ms": round(1e3 * median(times[1]), 3),
        "ratio": round(median(ratios), 3),
    }


def _seconds_per_call(function: Callable[[], object], calls: int) -> float:
    start = time.process_time()
    for _ in range(calls):
        function()
    return (time.process_time() - start) / calls
