"""Where the decisions of an agent's levels are read, for those who watch it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tensordict import NestedKey

from hdrqn_torchrl import keys
from hdrqn_torchrl.algorithms.levels import Level


@dataclass(frozen=True, kw_only=True)
class LevelView:
    """Entries of one level's decisions, in what a policy has acted on.

    Args:
        name: of the level.
        choice_key: what it chose.
        value_key: the Q-values it chose by, ``[*, A]``; policies write them while they are watched
            (:func:`~hdrqn_torchrl.modules.writing_values`).
        mask_key: what could be chosen, ``[*, A]`` bool; ``None``: everything.
        init_key: where it chose, ``[*, 1]`` bool; ``None``: at every step.
        reached_key: whether a step reached what it chose, ``[*, 1]`` bool; ``None`` for actions.
        reward_key: what a step paid it; ``None``: the task's own reward.
        choice_names: names of what it chooses among; empty for actions, which a scene names. Those of subgoals that an
            agent finds itself change as it finds some.

    Examples:
        >>> from hdrqn_torchrl.algorithms import make_hdrqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> agent = make_hdrqn(MultiGoalGridEnv(num_envs=2), compact_network(8, (8,)))
        >>> [(level.name, level.choice_key, level.value_key) for level in agent.levels]
        [('sub', 'action', 'action_value'), ('meta', 'subgoal', 'subgoal_value')]
    """

    name: str
    choice_key: NestedKey
    value_key: NestedKey
    mask_key: NestedKey | None = None
    init_key: NestedKey | None = None
    reached_key: NestedKey | None = None
    reward_key: NestedKey | None = None
    choice_names: Sequence[str] = ()


def views_of(
    levels: Sequence[Level], *, action_mask_key: NestedKey | None = None, masked: Sequence[bool] | None = None
) -> tuple[LevelView, ...]:
    """The usual entries of an agent's levels.

    Args:
        levels: from level 0 up.
        action_mask_key: the entry that tells which actions can be chosen; ``None``: all.
        masked: whether subgoals that can't be chosen are left out, for each level that chooses some; ``None``: yes.

    Examples:
        >>> from hdrqn_torchrl.algorithms.levels import make_levels
        >>> from hdrqn_torchrl.envs import SubgoalSet
        >>> rooms, goals = SubgoalSet(names=("a", "b"), prefix="rooms"), SubgoalSet(names=("x", "y"))
        >>> [view.value_key for view in views_of(make_levels(4, [rooms, goals]))]
        ['action_value', 'rooms_subgoal_value', 'subgoal_value']
    """
    uppers = levels[1:]
    masks = [True] * len(uppers) if masked is None else masked
    subgoal_views = (_view_of_subgoals(level, is_masked) for level, is_masked in zip(uppers, masks, strict=True))
    return (_view_of_actions(levels[0], action_mask_key), *subgoal_views)


def _view_of_actions(level: Level, mask_key: NestedKey | None) -> LevelView:
    return LevelView(
        name=level.name,
        choice_key=keys.ACTION,
        value_key=keys.ACTION_VALUE,
        mask_key=mask_key,
        reward_key=_reward_key(level),
    )


def _view_of_subgoals(level: Level, masked: bool) -> LevelView:
    assert level.choices is not None
    names = level.choices.keys
    return LevelView(
        name=level.name,
        choice_key=names.subgoal,
        value_key=names.subgoal_value,
        mask_key=names.subgoal_mask if masked else None,
        init_key=names.option_init,
        reached_key=names.subgoal_reached,
        reward_key=_reward_key(level),
        choice_names=level.choices.names,
    )


def _reward_key(level: Level) -> NestedKey | None:
    return None if level.pursues is None else level.pursues.keys.intrinsic_reward
