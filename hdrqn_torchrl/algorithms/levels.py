"""The levels of an agent: what each chooses among, and what it pursues.

Level 0 chooses primitive actions; level l > 0 chooses among the l-th set of subgoals, from near to far. Each level
pursues the subgoal that the level above has chosen; the top level pursues the task itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hdrqn_torchrl.envs import SubgoalSet


@dataclass(frozen=True, kw_only=True)
class Level:
    """One level of an agent.

    Args:
        name: ``"sub"`` (chooses actions), ``"meta"`` (chooses among the farthest subgoals), or else the prefix of the
            set of subgoals that it chooses among.
        num_choices: number of actions or subgoals.
        choices: the set of subgoals that it chooses among; ``None``: primitive actions.
        pursues: the set of subgoals that it can be given; ``None``: the whole task.

    Examples:
        >>> rooms, goals = SubgoalSet(names=("a", "b", "c"), prefix="rooms"), SubgoalSet(names=("x", "y"))
        >>> [(level.name, level.num_choices, level.num_conditions) for level in make_levels(4, [rooms, goals])]
        [('sub', 4, 3), ('rooms', 3, 2), ('meta', 2, 0)]
    """

    name: str
    num_choices: int
    choices: SubgoalSet | None
    pursues: SubgoalSet | None

    @property
    def num_conditions(self) -> int:
        """Number of subgoals that it can be given; 0 at the top."""
        return 0 if self.pursues is None else len(self.pursues)


def make_levels(num_actions: int, subgoals: Sequence[SubgoalSet]) -> tuple[Level, ...]:
    """The levels of an agent, from level 0 up.

    Args:
        num_actions: number of the environment's actions.
        subgoals: the sets of subgoals that it pursues, from near to far; empty: a flat agent.
    """
    choices = [None, *subgoals]
    pursued = [*subgoals, None]
    return tuple(
        Level(
            name="sub" if among is None else "meta" if above is None else among.prefix,
            num_choices=num_actions if among is None else len(among),
            choices=among,
            pursues=above,
        )
        for among, above in zip(choices, pursued, strict=True)
    )
