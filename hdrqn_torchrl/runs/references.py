"""What scripted players achieve on a task: known, kept on disk from earlier, or played now within a time limit."""

from __future__ import annotations

import hashlib
import json
import math
import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from hdrqn_torchrl import __version__
from hdrqn_torchrl.envs.task import Figures, Reference, Task
from hdrqn_torchrl.random_numbers import own_random_numbers

References = dict[str, dict[str, float]]
LONGEST_SECONDS = 120.0
"""Default time limit of each player."""


def references_for(
    task: Task,
    names: Sequence[str] | None = None,
    *,
    play: bool = True,
    seconds: float | None = LONGEST_SECONDS,
    tell: Callable[[str], None] | None = None,
) -> References:
    """What the scripted players of a task achieve, by name; empty for tasks that have none.

    Random numbers of a training that goes on meanwhile stay as they are.

    Args:
        task: as the environment states it (:func:`~hdrqn_torchrl.envs.task_of`).
        names: of the players; ``None``: all.
        play: whether those whose figures are not known may play. Those that may not are left out.
        seconds: how long each of them may play; one that needs more is left out. ``None``: as long as it takes.
        tell: called with a sentence before each plays, and if its time was up.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> references_for(MultiGoalGridEnv(2).task, ["memory"])["memory"]["return_mean"]
        2.0
    """
    found = {}
    for name in task.references if names is None else names:
        reference = task.references.get(name)
        if reference is None:
            continue
        figures = reference.known or _kept(reference)
        if figures is None and play:
            figures = _play(name, reference, seconds, tell or (lambda sentence: None))
        if figures is not None:
            found[name] = dict(figures)
    return found


def ceiling_of(references: References, task: Task) -> float | None:
    """Return of the player that marks the task's ceiling; ``None`` if there is none, or it has not played."""
    return references.get(task.ceiling or "", {}).get("return_mean")


class Players:
    """The scripted players of one task. Each plays once, when its figures are first asked for.

    Args:
        task: as the environment states it.
        play: ``False``: no figures at all, known ones neither.
        seconds: how long each may play.
        tell: called with a sentence before each plays, and if its time was up.
    """

    def __init__(
        self,
        task: Task,
        *,
        play: bool = True,
        seconds: float | None = LONGEST_SECONDS,
        tell: Callable[[str], None] | None = None,
    ) -> None:
        self.task, self.play, self.seconds, self.tell = task, play, seconds, tell
        self._asked: dict[str, References] = {}

    def __call__(self, names: Sequence[str] | None = None) -> References:
        """What they achieve; ``None``: all of them."""
        found: References = {}
        for name in (self.task.references if names is None else names) if self.play else ():
            if name not in self._asked:
                self._asked[name] = references_for(self.task, [name], seconds=self.seconds, tell=self.tell)
            found |= self._asked[name]
        return found

    def ceiling(self) -> float | None:
        """Return of the one that marks the ceiling."""
        return ceiling_of(self([self.task.ceiling] if self.task.ceiling else []), self.task)


def _play(name: str, reference: Reference, seconds: float | None, tell: Callable[[str], None]) -> Figures | None:
    limit = "" if seconds is None else f", for at most {seconds:g} s"
    tell(f"the scripted player {name!r} ({reference.what}) plays this task{limit}")
    try:
        with own_random_numbers():
            figures = reference.play(seconds)
    except TimeoutError:
        tell(f"the scripted player {name!r} was not done after {seconds:g} s: it is left out")
        return None
    _keep(reference, figures)
    return figures


def cache_folder() -> Path:
    """Where figures are kept: below ``$XDG_CACHE_HOME``, or ``~/.cache``."""
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "hdrqn_torchrl" / "references"


def _place(reference: Reference) -> Path:
    return cache_folder() / f"{hashlib.sha256(f'{__version__} {reference.key}'.encode()).hexdigest()[:32]}.json"


def _kept(reference: Reference) -> Figures | None:
    """Figures from disk; ``None`` if there are none, or none that can be read."""
    if not reference.key:
        return None
    try:
        kept = json.loads(_place(reference).read_text())
    except (OSError, ValueError, RuntimeError):  # RuntimeError: there is no home folder
        return None
    if not isinstance(kept, dict) or kept.get("key") != reference.key or not isinstance(kept.get("figures"), dict):
        return None
    figures = kept["figures"]
    sound = all(isinstance(value, (int, float)) and math.isfinite(value) for value in figures.values())
    return figures if sound and "return_mean" in figures else None


def _keep(reference: Reference, figures: Figures) -> None:
    """Writes figures to disk, whole or not at all. Where nothing can be written they are played again next time."""
    if not reference.key:
        return
    with suppress(OSError, RuntimeError):
        place = _place(reference)
        place.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=place.parent, suffix=".partial", delete=False) as file:
            json.dump({"key": reference.key, "figures": dict(figures)}, file)
        Path(file.name).replace(place)
