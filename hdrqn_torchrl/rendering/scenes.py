"""The scene of any environment: the one that its task names or, failing that, what it shows to the outside."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from rich.text import Text
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.batched_envs import BatchedEnvBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs import Task, task_of
from hdrqn_torchrl.envs.scene import Colour, Scene, colours, fitted, font

_INK, _PAPER = (30, 30, 30), (255, 255, 255)
_LONGEST_LINE, _MOST_LINES = 60, 24


def scene_of(
    env: EnvBase, *, subgoal: int | None = None, action: int | None = None, observation: Tensor | None = None
) -> Scene:
    """The present moment of a bare environment with one world.

    Args:
        env: bare environment with batch size ``[1]``.
        subgoal: the subgoal in force, to be highlighted; ``None`` for flat agents.
        action: the action that is about to be done; ``None`` once the episode is over.
        observation: what the agent sees, for environments that have no scene of their own.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> scene = scene_of(MultiGoalGridEnv(num_envs=1, seed=0), subgoal=1)
        >>> scene.draw_world(330).size, scene.draw_view(150).size
        ((330, 330), (150, 150))
    """
    task = task_of(env)
    if task.scene is not None:
        return task.scene(env, subgoal=subgoal, action=action)
    return PlainScene(
        action_names=action_names(env, task),
        subgoal_names=subgoal_names(env, task),
        rendered=_rendered(env),
        observation=None if observation is None else observation.detach().cpu().numpy(),
        parts=() if isinstance(env, BatchedEnvBase) else getattr(env, "observation_parts", ()),
    )


def action_names(env: EnvBase, task: Task) -> tuple[str, ...]:
    """As the task states them, or numbers."""
    number = getattr(env.full_action_spec[keys.ACTION], "n", 1)
    return task.actions or tuple(f"action {index}" for index in range(number))


def subgoal_names(env: EnvBase, task: Task) -> tuple[str, ...]:
    """Those of the farthest set as the task states them, or numbers."""
    if task.subgoals:
        return task.subgoals[-1].names
    attained = env.observation_spec.get(keys.ATTAINED, None)
    return tuple(f"subgoal {index}" for index in range(0 if attained is None else attained.shape[-1]))


@dataclass(frozen=True, eq=False)  # arrays have no single answer to ==
class PlainScene:
    """A moment of an environment that has no scene of its own: what it renders, and what the agent sees.

    Args:
        action_names: name of each action.
        subgoal_names: name of each subgoal.
        rendered: a picture ``[height, width, 3]`` uint8, a string, or nothing.
        observation: what the agent sees.
        parts: names and sizes of the entries that a vector is joined from, if it is.

    Examples:
        >>> scene = PlainScene(("left", "right"), (), rendered=None, observation=np.array([0.5, -1.0]))
        >>> scene.write_view().plain
        '[ 0.5 -1. ]'
        >>> scene.draw_world(330).size
        (330, 330)
    """

    action_names: tuple[str, ...]
    subgoal_names: tuple[str, ...]
    rendered: NDArray[np.uint8] | str | None
    observation: NDArray | None
    parts: tuple[tuple[str, int], ...] = ()

    hazard = "hazard"

    @property
    def subgoal_colours(self) -> tuple[Colour, ...]:
        """One for each, in turn."""
        return colours(len(self.subgoal_names))

    def outcome(self, success: bool, terminated: bool) -> str:
        """How an episode ended."""
        return "success" if success else "over" if terminated else "time is up"

    def draw_world(self, size: int) -> Image.Image:
        """What the environment renders or, failing that, what the agent sees."""
        if isinstance(self.rendered, np.ndarray):
            return fitted(self.rendered, size)
        return _written(self.write_world().plain, size)

    def draw_view(self, size: int) -> Image.Image:
        """The observation as a picture if it is one, else in numbers."""
        if (picture := _as_picture(self.observation)) is not None:
            return fitted(picture, size)
        return _written(self.write_view().plain, size)

    def write_world(self) -> Text:
        """What the environment renders as text, or the observation."""
        return Text(_cut(self.rendered)) if isinstance(self.rendered, str) else self.write_view()

    def write_view(self) -> Text:
        """The observation in numbers."""
        if self.observation is None:
            return Text("no picture")
        if not self.parts:
            return Text(_cut(_numbers(self.observation)))
        ends = np.cumsum([size for _, size in self.parts])[:-1]
        values = zip(self.parts, np.split(self.observation, ends), strict=True)
        return Text(_cut("\n".join(f"{_short(name)} {_numbers(value)}" for (name, _), value in values)))


def _numbers(array: NDArray) -> str:
    return np.array2string(array, precision=2, threshold=200, max_line_width=_LONGEST_LINE, suppress_small=True)


def _short(name: str) -> str:
    """``camera.left`` of ``observation['camera']['left']``."""
    return ".".join(re.findall(r"\['?([^]']+)'?\]", name))


def _rendered(env: EnvBase) -> NDArray[np.uint8] | str | None:
    """What ``render`` returns, if it is a picture or a string."""
    if isinstance(env, BatchedEnvBase):  # a worker process that lacks an attribute ends when it is asked for it
        return None
    render: Callable | None = getattr(env, "render", None)
    shown = render() if callable(render) else None
    if isinstance(shown, str):
        return shown
    if isinstance(shown, Tensor):
        shown = shown.detach().cpu().numpy()
    if isinstance(shown, np.ndarray) and shown.ndim == 4:  # of several worlds
        shown = shown[0]
    is_picture = isinstance(shown, np.ndarray) and shown.ndim == 3 and shown.shape[-1] == 3
    return np.ascontiguousarray(shown, np.uint8) if is_picture else None


def _as_picture(observation: NDArray | None) -> NDArray[np.uint8] | None:
    """An observation ``[3, height, width]`` or ``[height, width, 3]`` of bytes."""
    if observation is None or observation.ndim != 3 or observation.dtype != np.uint8:
        return None
    if observation.shape[0] == 3:
        observation = observation.transpose(1, 2, 0)
    return np.ascontiguousarray(observation) if observation.shape[-1] == 3 else None


def _written(text: str, size: int) -> Image.Image:
    """Text on a plain background, as large as it fits."""
    image, letters = Image.new("RGB", (size, size), _PAPER), 16
    draw = ImageDraw.Draw(image)
    while letters > 6 and draw.multiline_textbbox((0, 0), text, font(letters))[2] > size - 8:
        letters -= 1
    draw.multiline_text((4, 4), text, _INK, font(letters))
    return image


def _cut(text: str) -> str:
    return "\n".join(line[:_LONGEST_LINE] for line in text.splitlines()[:_MOST_LINES])
