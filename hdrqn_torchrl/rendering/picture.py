"""A recorded moment as a picture: the world, and next to it what the agent sees, wants (Q^M) and does (Q^S)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from hdrqn_torchrl.rendering.frames import Frame
from hdrqn_torchrl.rendering.levels import BarSpans, Level, caption, levels_of
from hdrqn_torchrl.rendering.style import font

WIDTH, HEIGHT = 760, 456  # even numbers, which video codecs need
_MARGIN, _TOP, _WORLD, _VIEW = 12, 40, 374, 130
_LEFT = _MARGIN + _WORLD + 20  # of the right-hand column
_RIGHT, _BOTTOM = WIDTH - _MARGIN, _TOP + _WORLD
_TITLE = 25  # height of a title

_PAPER, _INK, _FAINT = (255, 255, 255), (32, 32, 32), (120, 120, 120)
_PALE, _MASKED, _TRACK = (200, 200, 200), (175, 175, 175), (242, 242, 242)  # bars not chosen, masked names, empty bars
_GOOD, _BAD = (44, 160, 44), (112, 112, 112)


def draw_frame(frame: Frame, spans: BarSpans = BarSpans()) -> NDArray[np.uint8]:  # noqa: B008 (immutable)
    """Draws one moment.

    Args:
        frame: from :func:`~hdrqn_torchrl.rendering.record_episodes`.
        spans: scales of the bars, the same for a whole recording (:func:`bar_spans`).

    Returns:
        ``[456, 760, 3]`` uint8 RGB.

    Examples:
        >>> from hdrqn_torchrl.algorithms import make_hdrqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> from hdrqn_torchrl.rendering import bar_spans, record_episodes
        >>> env = MultiGoalGridEnv(num_envs=1, max_steps=3)
        >>> agent = make_hdrqn(env, compact_network(8, (8,)))
        >>> frames = record_episodes(agent.transform(env), agent)
        >>> draw_frame(frames[0], bar_spans(frames)).shape
        (456, 760, 3)
    """
    image = Image.new("RGB", (WIDTH, HEIGHT), _PAPER)
    draw = ImageDraw.Draw(image)
    _paste(image, frame.scene.draw_world(_WORLD), _MARGIN, _TOP, _WORLD)
    _draw_header(draw, frame)
    draw.text((_LEFT, _TOP - 27), "sees", _INK, font(16, bold=True))
    _paste(image, frame.scene.draw_view(_VIEW), _LEFT, _TOP, _VIEW)
    _draw_score(draw, frame, _LEFT + _VIEW + 28)
    levels = levels_of(frame, spans)
    _draw_levels(draw, levels)
    _draw_caption(draw, frame, levels)
    return np.asarray(image)


def _paste(image: Image.Image, picture: Image.Image, left: int, top: int, size: int) -> None:
    """Puts a picture into a square, on the left and vertically centred."""
    image.paste(picture, (left, top + (size - picture.height) // 2))


def _draw_header(draw: ImageDraw.ImageDraw, frame: Frame) -> None:
    limit = "" if frame.max_steps is None else f" of {frame.max_steps}"
    draw.text((_MARGIN, _TOP - 28), f"step {frame.score.steps}{limit}", _INK, font(16, bold=True))
    episode = f"episode {frame.episode} of {frame.episodes}"
    draw.text((_MARGIN + _WORLD, _TOP - 26), episode, _FAINT, font(14), anchor="ra")


def _draw_score(draw: ImageDraw.ImageDraw, frame: Frame, left: int) -> None:
    """The rewards so far."""
    score = frame.score
    rows = [("rᵉˣ", "episode", score.extrinsic)]
    if score.intrinsic is not None:
        rows += [("rⁱⁿ", "episode", score.intrinsic), ("rⁱⁿ", "option", score.option_intrinsic)]
    else:
        rows += [("r", "episode", score.total)]
    draw.text((left, _TOP - 27), "got so far", _INK, font(16, bold=True))
    for place, (symbol, label, value) in enumerate(rows):
        baseline = _TOP + 26 + 36 * place
        draw.text((left, baseline), symbol, _INK, font(18), anchor="ls")
        draw.text((left + 42, baseline), label, _FAINT, font(14), anchor="ls")
        draw.text((_RIGHT, baseline), f"{value:.2f}", _INK, font(18, bold=True), anchor="rs")


def _draw_levels(draw: ImageDraw.ImageDraw, levels: list[Level]) -> None:
    top, gap = _TOP + _VIEW + 20, 12
    names = [name for level in levels if not level.brief for name in level.names]
    row = min(24, (_BOTTOM - top - _TITLE * len(levels) - gap * (len(levels) - 1)) // len(names))
    size = min(14, max(row - 3, 6))
    start = _LEFT + 12 + max(draw.textlength(name, font(size, bold=True)) for name in names)
    for level in levels:
        _draw_title(draw, level, top)
        if not level.brief:
            _draw_bars(draw, level, round(start), top + _TITLE, row, size)
            top += row * len(level.names)
        top += _TITLE + gap


def _draw_title(draw: ImageDraw.ImageDraw, level: Level, top: int) -> None:
    """The choice on its colour, and how long it has lasted."""
    middle, choice = top + 9, level.decision.choice
    draw.text((_LEFT, middle), level.verb, _INK, font(16, bold=True), anchor="lm")
    start = _LEFT + draw.textlength(level.verb, font(16, bold=True)) + 10
    end = start + draw.textlength(level.names[choice], font(14, bold=True)) + 14
    draw.rounded_rectangle((start, top - 1, end, top + 19), 4, fill=level.colours[choice])
    draw.text((start + 7, middle), level.names[choice], _PAPER, font(14, bold=True), anchor="lm")
    free = _RIGHT - end - 8 - draw.textlength(level.symbol, font(16)) - 6
    size = next((size for size in range(13, 8, -1) if draw.textlength(level.note, font(size)) <= free), 8)
    draw.text((end + 8, middle), level.note, _FAINT, font(size), anchor="lm")
    draw.text((_RIGHT, middle), level.symbol, _FAINT, font(16), anchor="rm")


def _draw_bars(draw: ImageDraw.ImageDraw, level: Level, start: int, top: int, row: int, size: int) -> None:
    """Name, bar and value of each choice; ``row`` is the height of a row, ``size`` that of the font."""
    end = round(_RIGHT - draw.textlength("-0.000", font(size, bold=True)) - 8)
    for index, name in enumerate(level.names):
        chosen = index == level.decision.choice
        ink = _INK if level.decision.allowed[index] else _MASKED
        gap = min(3, row // 6)
        upper, middle, lower = top + row * index + gap, top + row * (index + 0.5), top + row * (index + 1) - gap - 1
        draw.text((_LEFT, middle), name, ink, font(size, bold=chosen), anchor="lm")
        draw.rectangle((start, upper, end, lower), fill=_TRACK)
        draw.text((start + 6, middle), level.remark(index), ink, font(size), anchor="lm")
        if length := level.bar(index):
            colour = level.colours[index] if chosen else _PALE
            draw.rectangle((start, upper, start + length * (end - start), lower), fill=colour)
        value = f"{level.decision.values[index]:.3f}"
        draw.text((_RIGHT, middle), value, ink, font(size, bold=chosen), anchor="rm")


def _draw_caption(draw: ImageDraw.ImageDraw, frame: Frame, levels: list[Level]) -> None:
    """What happened in the step; if nothing did, the scale of the bars."""
    middle, text = (_BOTTOM + HEIGHT) // 2, caption(frame)
    if not frame.outcome:
        scales = ", ".join(f"{level.span:g} ({level.symbol})" for level in levels if not level.brief)
        scales = f"full bar: the best Q-value; empty bar: worse by {scales} or more"
        draw.text((_MARGIN, middle), text or scales, _INK if text else _FAINT, font(15 if text else 13), anchor="lm")
        return
    colour = _GOOD if frame.success else _BAD
    draw.rectangle((_MARGIN, _BOTTOM + 7, _RIGHT - 1, HEIGHT - 8), fill=colour)
    draw.text((_MARGIN + 10, middle), text, _PAPER, font(15, bold=True), anchor="lm")
