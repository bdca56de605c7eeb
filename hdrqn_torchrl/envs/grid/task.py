"""What the grid tasks state about themselves."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from torchrl.envs import EnvBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.grid.measured import measured
from hdrqn_torchrl.envs.grid.rules import ACTIONS, GridRules
from hdrqn_torchrl.envs.grid.symmetries import grid_symmetries
from hdrqn_torchrl.envs.subgoals import SubgoalSet
from hdrqn_torchrl.envs.task import Figures, Reference, Task

if TYPE_CHECKING:
    from hdrqn_torchrl.envs.scene import Scene

ROOMS = keys.OptionKeys("rooms")  # of rooms, doors and goals as nearer subgoals
PLAYERS = {
    "planner": "full information",
    "memory": "perfect memory of the agent's own view",
    "egocentric": "perfect memory, but not where it starts",
    "random": "chance",
}


def grid_task(rules: GridRules, settings: Mapping[str, Any]) -> Task:
    """The task of a grid.

    Args:
        rules: of the grid.
        settings: of :class:`~hdrqn_torchrl.envs.MultiGoalGridEnv`, all that make the task.
    """
    goals = float(rules.num_goals)
    return Task(  # a goal pays 1 at most
        max_steps=settings["max_steps"],
        largest_return=goals,
        largest_extrinsic_return=goals,
        smallest_extrinsic_return=0.0,
        subgoals=subgoals_of(rules),
        ordered=True,
        actions=ACTIONS,
        references={name: _reference(name, what, settings) for name, what in PLAYERS.items()},
        ceiling="memory",
        symmetries=grid_symmetries(settings["layout"], rules.view) if rules.places is None else (),
        scene=grid_scene,
    )


def subgoals_of(rules: GridRules) -> tuple[SubgoalSet, ...]:
    """The sets of subgoals of a grid task, from near to far: rooms, doors and goals if there are rooms; the goals."""
    goals = SubgoalSet(names=rules.goal_names)
    if rules.places is None:
        return (goals,)
    return SubgoalSet(names=rules.near_names, prefix=ROOMS.prefix, repeatable=True), goals


def grid_scene(env: EnvBase, *, subgoal: int | None = None, action: int | None = None) -> Scene:
    """The present moment of a :class:`~hdrqn_torchrl.envs.MultiGoalGridEnv` with one world."""
    from hdrqn_torchrl.envs.grid.scene import GridScene  # takes a second: it loads what draws

    return GridScene(env.rules, env.state, subgoal, action)


def _reference(player: str, what: str, settings: Mapping[str, Any]) -> Reference:
    simulation = Simulation(player, dict(settings))
    key = json.dumps({"player": player, **settings}, default=list, sort_keys=True)
    return Reference(what=what, play=simulation, known=measured(player, settings), key=key)


@dataclass(frozen=True)
class Simulation:
    """A scripted player and a grid task that it can play. (A value, so that it travels to other processes.)"""

    player: str
    settings: dict[str, Any]

    def __call__(self, seconds: float | None = None) -> Figures:
        """Plays a thousand episodes; see :class:`~hdrqn_torchrl.envs.Reference`."""
        from hdrqn_torchrl.envs.grid.scripted import scripted_ceiling  # which needs the environment that names it

        return scripted_ceiling(self.player, **self.settings, seconds=seconds)  # type: ignore[arg-type]
