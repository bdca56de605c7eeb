"""Recorded episodes: what the agent sees, wants and does, as pictures, videos and terminal text."""

from hdrqn_torchrl.rendering.episodes import record_episodes
from hdrqn_torchrl.rendering.frames import Decision, Frame, Pursuit, Score
from hdrqn_torchrl.rendering.levels import BarSpans, bar_spans
from hdrqn_torchrl.rendering.picture import draw_frame
from hdrqn_torchrl.rendering.scenes import PlainScene, scene_of
from hdrqn_torchrl.rendering.terminal import draw_text, play_in_terminal
from hdrqn_torchrl.rendering.video import check_video, hold, write_video

__all__ = [
    "BarSpans",
    "Decision",
    "Frame",
    "PlainScene",
    "Pursuit",
    "Score",
    "bar_spans",
    "check_video",
    "draw_frame",
    "draw_text",
    "hold",
    "play_in_terminal",
    "record_episodes",
    "scene_of",
    "write_video",
]
