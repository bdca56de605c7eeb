"""What a task is, as far as it can be told: stored with a run, and compared where the run goes on."""

from __future__ import annotations

import json
import warnings
from collections.abc import Container
from pathlib import Path
from typing import Any

from torchrl.envs import EnvBase

from hdrqn_torchrl.envs import task_of
from hdrqn_torchrl.envs.specs import interface
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.files import RunFileError, read_json, write_whole
from hdrqn_torchrl.runs.settings.arguments import shown

Facts = dict[str, Any]


def facts_of(env: EnvBase) -> Facts:
    """What an environment shows and states, as plain data.

    Args:
        env: bare environment.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> facts_of(MultiGoalGridEnv(4, num_goals=2))["names of subgoals"]
        'goal 1, goal 2'
    """
    task = task_of(env)
    sets = {f"names of subgoals{f' ({each.prefix})' if each.prefix else ''}": each.names for each in task.subgoals}
    return {
        **interface(env),
        "longest episode": str(task.max_steps),
        "largest return": str(task.largest_return),
        "largest extrinsic return": str(task.largest_extrinsic_return),
        "smallest extrinsic return": str(task.smallest_extrinsic_return),
        "order of subgoals": str(task.ordered),
        "names of actions": ", ".join(task.actions),
        **{name: ", ".join(names) for name, names in sets.items()},
    }


def check_facts(folder: Path, facts: Facts) -> None:
    """Refuses to go on with a run on another task. Runs of earlier versions, which stored no facts, are let pass.

    Args:
        folder: of the run.
        facts: of the environment as it is now.

    Raises:
        ValueError: naming all that changed.
    """
    path = folder / layout.TASK
    if not path.exists():
        return
    if changed := _changed(path, facts):
        lines = "\n  ".join(changed)
        raise ValueError(
            f"the task must be that of the run that is resumed, and differs from {folder}:\n  {lines}\n"
            "Bring back the environment as it was, or take the new one with resume_override=true."
        )


def warn_of_other_names(folder: Path, env: EnvBase) -> None:
    """Warns if subgoals or actions are called otherwise than when the run was trained: others are meant, perhaps.

    Args:
        folder: of the run.
        env: bare environment in which its agent is to play.
    """
    facts = {name: each for name, each in facts_of(env).items() if name.startswith("names of ")}
    try:
        changed = _changed(folder / layout.TASK, facts, only=facts)
    except (OSError, RunFileError):  # not there, as in runs of earlier versions, or damaged: the agent can play
        return
    if changed:
        warnings.warn(
            f"names should be those of the training in {folder}, got others: {'; '.join(changed)}. If their order "
            "changed, the agent means others than these names say.",
            stacklevel=3,
        )


def _changed(path: Path, facts: Facts, only: Container[str] | None = None) -> list[str]:
    """What differs from the stored facts, a line each; of those named by ``only``."""
    stored = read_json(path, root=path.parent)
    before = stored if isinstance(stored, dict) else {}
    return [
        f"{name if name in facts else shown(name)}: {shown(before.get(name, 'none'))} -> {facts.get(name, 'none')}"
        for name in {**before, **facts}
        if before.get(name) != facts.get(name) and (only is None or name in only)
    ]


def write_facts(folder: Path, facts: Facts) -> None:
    """Stores them for :func:`check_facts`."""
    write_whole(folder / layout.TASK, json.dumps(facts, indent=2) + "\n")
