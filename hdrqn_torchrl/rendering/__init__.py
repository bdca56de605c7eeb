"""Recorded episodes: what the agent sees, wants and does, as pictures, videos and terminal text."""

from hdrqn_torchrl.rendering.episodes import record_episodes
from hdrqn_torchrl.rendering.excerpts import excerpt
from hdrqn_torchrl.rendering.frames import Decision, Frame, Pursuit, Score
from hdrqn_torchrl.rendering.levels import BarSpans, bar_spans
from hdrqn_torchrl.rendering.picture import draw_frame
from hdrqn_torchrl.rendering.scenes import PlainScene, scene_of
from hdrqn_torchrl.rendering.sheet import SubgoalRecord, draw_sheet, subgoal_records
from hdrqn_torchrl.rendering.terminal import draw_text, play_in_terminal
from hdrqn_torchrl.rendering.video import check_video, hold, write_video

__all__ = [
    "BarSpans",
    "Decision",
    "Frame",
    "PlainScene",
    "Pursuit",
    "Score",
    "SubgoalRecord",
    "bar_spans",
    "check_video",
    "draw_frame",
    "draw_sheet",
    "draw_text",
    "excerpt",
    "hold",
    "play_in_terminal",
    "record_episodes",
    "scene_of",
    "subgoal_records",
    "write_video",
]
