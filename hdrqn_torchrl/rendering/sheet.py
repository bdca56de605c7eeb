"""A sheet with all subgoals of an agent: moments in which each was attained, how often, and what it is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from hdrqn_torchrl.rendering.frames import Frame
from hdrqn_torchrl.rendering.style import font

_PAPER, _INK, _FAINT, _LINE = (255, 255, 255), (32, 32, 32), (120, 120, 120), (225, 225, 225)
_MARGIN, _TEXT, _ROW, _PICTURE, _ARROW = 14, 250, 132, 108, 22
_MOMENT = 2 * _PICTURE + _ARROW + 18


@dataclass(frozen=True)
class SubgoalRecord:
    """What recorded episodes say about a subgoal.

    Attributes:
        name: in words.
        episodes: share of the episodes in which it was attained.
        options: how many pursued it.
        reached: share of them that attained it; NaN if there were none.
        value: mean Q-value at which they chose it; NaN likewise.
        moments: frames before and after it was attained, for the first time in an episode.
    """

    name: str
    episodes: float
    options: int
    reached: float
    value: float
    moments: tuple[tuple[Frame, Frame], ...]


def subgoal_records(frames: Sequence[Frame]) -> list[SubgoalRecord]:
    """Of each subgoal of the farthest set.

    Args:
        frames: of whole episodes (:func:`~hdrqn_torchrl.rendering.record_episodes`) of an agent with subgoals.

    Raises:
        ValueError: if the agent has none.

    Examples:
        >>> from hdrqn_torchrl.algorithms import make_hdrqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> from hdrqn_torchrl.rendering import record_episodes
        >>> env = MultiGoalGridEnv(num_envs=1, max_steps=3)
        >>> agent = make_hdrqn(env, compact_network(8, (8,)))
        >>> records = subgoal_records(record_episodes(agent.transform(env), agent, episodes=2))
        >>> [record.name for record in records]
        ['goal 1', 'goal 2']
    """
    if not frames or not frames[0].pursuits:
        raise ValueError("frames must be those of an agent that pursues subgoals, got others; a flat agent has none.")
    names = frames[0].pursuits[-1].names
    moments: list[list[tuple[Frame, Frame]]] = [[] for _ in names]
    options: list[list[tuple[float, bool]]] = [[] for _ in names]
    for before, after in pairwise(frames):
        if before.pursuits[-1].steps == 0 and not before.outcome:
            decision = before.pursuits[-1].decision
            options[decision.choice].append((decision.values[decision.choice], False))
        if before.outcome:
            continue
        choice = before.pursuits[-1].decision.choice
        if after.attained[choice]:
            options[choice][-1] = (options[choice][-1][0], True)
        for subgoal, (was, now) in enumerate(zip(before.score.reached, after.score.reached, strict=True)):
            if now and not was:
                moments[subgoal].append((before, after))
    played = frames[-1].episode
    return [
        SubgoalRecord(
            name=name,
            episodes=len(seen) / played,
            options=len(tried),
            reached=_mean([reached for _, reached in tried]),
            value=_mean([value for value, _ in tried]),
            moments=tuple(seen),
        )
        for name, seen, tried in zip(names, moments, options, strict=True)
    ]


def _mean(numbers: Sequence[float]) -> float:
    return float(np.mean(numbers)) if numbers else float("nan")


def draw_sheet(
    records: Sequence[SubgoalRecord], *, found: Sequence[int] | None = None, moments: int = 3
) -> NDArray[np.uint8]:
    """One row for each subgoal that was attained or pursued: figures, and moments before and after.

    Args:
        records: of all subgoals.
        found: frames of the training after which each was found; ``None``: they were given.
        moments: how many are shown, spread over all.

    Returns:
        ``[height, width, 3]`` uint8 RGB.

    Examples:
        >>> records = [SubgoalRecord("key", 0.5, options=4, reached=0.25, value=0.8, moments=())]
        >>> draw_sheet(records, moments=2).shape
        (160, 790, 3)
    """
    rows = [(place, each) for place, each in enumerate(records) if each.moments or each.options]
    width, height = 2 * _MARGIN + _TEXT + moments * _MOMENT, 2 * _MARGIN + _ROW * max(1, len(rows))
    image = Image.new("RGB", (width, height), _PAPER)
    draw = ImageDraw.Draw(image)
    for row, (place, record) in enumerate(rows):
        top = _MARGIN + row * _ROW
        if row:
            draw.line((_MARGIN, top - 6, width - _MARGIN, top - 6), _LINE)
        _write(draw, record, None if found is None else found[place], top)
        for column, (before, after) in enumerate(_spread(record.moments, moments)):
            _draw_moment(image, draw, before, after, _MARGIN + _TEXT + column * _MOMENT, top)
    return np.asarray(image)


def _spread(moments: Sequence[tuple[Frame, Frame]], number: int) -> list[tuple[Frame, Frame]]:
    """A few, from the first to the last."""
    places = sorted({round(place) for place in np.linspace(0, len(moments) - 1, number)}) if moments else []
    return [moments[place] for place in places]


def _write(draw: ImageDraw.ImageDraw, record: SubgoalRecord, found: int | None, top: int) -> None:
    lines = [f"attained in {record.episodes:.0%} of episodes"]
    if record.options:
        lines += [f"{record.options} options, {record.reached:.0%} reached it", f"value {record.value:.2f}"]
    if found:
        lines.append(f"found after {found:,} frames")
    size = next((size for size in range(15, 9, -1) if draw.textlength(record.name, font(size)) < _TEXT - 40), 9)
    draw.text((_MARGIN, top), record.name, _INK, font(size, bold=True))
    for place, line in enumerate(lines):
        draw.text((_MARGIN, top + 26 + 20 * place), line, _FAINT, font(13))


def _draw_moment(
    image: Image.Image, draw: ImageDraw.ImageDraw, before: Frame, after: Frame, left: int, top: int
) -> None:
    """What the agent saw before and after the step."""
    for frame, start in ((before, left), (after, left + _PICTURE + _ARROW)):
        picture = frame.scene.draw_view(_PICTURE)
        image.paste(picture, (start, top + (_PICTURE - picture.height) // 2))
    draw.text((left + _PICTURE + _ARROW // 2, top + _PICTURE // 2), "→", _INK, font(16), anchor="mm")
