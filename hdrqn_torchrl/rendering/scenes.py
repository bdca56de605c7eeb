"""One moment of a task, ready to be drawn: the world, the agent's view, and the names of things in it.

A new kind of task gets a class with the members of :class:`Scene` and a line in :func:`scene_of`.
"""

from __future__ import annotations

from typing import Protocol

from PIL import Image
from rich.text import Text
from torchrl.envs import EnvBase

from hdrqn_torchrl.envs import MontezumaEnv, MultiGoalGridEnv
from hdrqn_torchrl.rendering.grid_scene import GridScene
from hdrqn_torchrl.rendering.screen_scene import ScreenScene
from hdrqn_torchrl.rendering.style import Colour


class Scene(Protocol):
    """What pictures and terminal text need to know about a moment of a task."""

    @property
    def action_names(self) -> tuple[str, ...]:
        """Name of each action."""

    @property
    def subgoal_names(self) -> tuple[str, ...]:
        """Name of each subgoal."""

    @property
    def subgoal_colours(self) -> tuple[Colour, ...]:
        """Colour of each subgoal."""

    @property
    def hazard(self) -> str:
        """What happened when the environment reports a hazard."""

    def outcome(self, success: bool, terminated: bool) -> str:
        """How an episode ended."""

    def draw_world(self, size: int) -> Image.Image:
        """The whole world, at most ``size`` pixels wide and high."""

    def draw_view(self, size: int) -> Image.Image:
        """What the agent sees, at most ``size`` pixels wide and high."""

    def write_world(self) -> Text:
        """The whole world in characters."""

    def write_view(self) -> Text:
        """What the agent sees in characters."""


def scene_of(env: EnvBase, *, subgoal: int | None = None, action: int | None = None) -> Scene:
    """The present moment of a bare environment with one world.

    Args:
        env: bare environment with batch size ``[1]``.
        subgoal: the subgoal in force, to be highlighted; ``None`` for flat agents.
        action: the action that is about to be done; ``None`` once the episode is over.

    Raises:
        ValueError: if there is no picture of this kind of environment.

    Examples:
        >>> scene = scene_of(MultiGoalGridEnv(num_envs=1, seed=0), subgoal=1)
        >>> scene.draw_world(330).size, scene.draw_view(150).size
        ((330, 330), (150, 150))
    """
    if isinstance(env, MultiGoalGridEnv):
        return GridScene(env.rules, env.state, subgoal, action)
    if isinstance(env, MontezumaEnv):
        return ScreenScene.of(env, subgoal)
    raise ValueError(
        f"env must be a MultiGoalGridEnv or a MontezumaEnv to be drawn, got {type(env).__name__}; "
        "give it a class with the members of Scene and a line in scene_of."
    )
