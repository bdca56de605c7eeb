"""Plays recorded episodes as text in a terminal."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from hdrqn_torchrl.rendering.frames import Frame
from hdrqn_torchrl.rendering.levels import BarSpans, Level, bar_spans, caption, levels_of
from hdrqn_torchrl.rendering.video import check_video, hold

_BAR = 16  # characters


def draw_text(frame: Frame, spans: BarSpans = BarSpans()) -> RenderableType:  # noqa: B008 (immutable)
    """One moment as text for rich: the world, what the agent sees, wants and does, and its rewards so far.

    Args:
        frame: from :func:`~hdrqn_torchrl.rendering.record_episodes`.
        spans: scales of the bars (:func:`~hdrqn_torchrl.rendering.bar_spans`).

    Examples:
        >>> from rich.console import Console
        >>> from hdrqn_torchrl.algorithms import make_hdrqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> from hdrqn_torchrl.rendering import record_episodes
        >>> env = MultiGoalGridEnv(num_envs=1, max_steps=3)
        >>> agent = make_hdrqn(env, compact_network(8, (8,)))
        >>> frames = record_episodes(agent.transform(env), agent)
        >>> Console().print(draw_text(frames[0]))
        episode 1 of 1   step 0 of 3   rᵉˣ 0.00   rⁱⁿ 0.00, this option 0.00
        ...
    """
    scenes = Table.grid(padding=(0, 3))
    scenes.add_row(_heading("world"), _heading("sees"))
    scenes.add_row(frame.scene.write_world(), frame.scene.write_view())
    bars = Table.grid(padding=(0, 3))
    levels = levels_of(frame, spans)
    bars.add_row(*(_heading(f"{level.verb} {level.names[level.decision.choice]} {level.note}") for level in levels))
    bars.add_row(*("" if level.brief else _bars(level) for level in levels))
    style = "bold" if frame.outcome else ""
    return Group(_header(frame), "", scenes, "", bars, "", Text(caption(frame) or " ", style))


def play_in_terminal(frames: Sequence[Frame], console: Console | None = None, *, fps: int = 4) -> None:
    """Shows frames in place, at ``fps``; if the output is not a terminal, prints all of them at once.

    Args:
        frames: what :func:`~hdrqn_torchrl.rendering.record_episodes` returned.
        console: where to show them; ``None``: the standard output.
        fps: steps per second.

    Raises:
        ValueError: if ``fps`` is out of range.
    """
    check_video(None, fps=fps)
    console, spans = console or Console(), bar_spans(frames)
    if not console.is_terminal:
        for frame in frames:
            console.print(draw_text(frame, spans), "")
        return
    with Live(console=console, auto_refresh=False) as live:
        for frame in frames:
            live.update(draw_text(frame, spans), refresh=True)
            time.sleep(hold(frame, fps) / fps)


def _heading(text: str) -> Text:
    return Text(text.strip(), "bold")


def _header(frame: Frame) -> Text:
    score = frame.score
    limit = "" if frame.max_steps is None else f" of {frame.max_steps}"
    parts = [f"episode {frame.episode} of {frame.episodes}", f"step {score.steps}{limit}", f"rᵉˣ {score.extrinsic:.2f}"]
    if score.intrinsic is None:
        parts.append(f"r {score.total:.2f}")
    else:
        parts.append(f"rⁱⁿ {score.intrinsic:.2f}, this option {score.option_intrinsic:.2f}")
    return Text("   ".join(parts))


def _bars(level: Level) -> Table:
    """Name, bar and value of each choice; an arrow marks the chosen one, and masked ones are dim."""
    table = Table.grid(padding=(0, 1))
    for index, name in enumerate(level.names):
        chosen, allowed = index == level.decision.choice, level.decision.allowed[index]
        style = "bold" if chosen else "" if allowed else "dim"
        filled = round(_BAR * level.bar(index))
        bar = Text(level.remark(index) or "█" * filled + "░" * (_BAR - filled), style)
        value = f"{level.decision.values[index]:.3f}"
        table.add_row(Text(">" if chosen else " "), Text(name, style), bar, Text(value.rjust(6), style))
    return table
