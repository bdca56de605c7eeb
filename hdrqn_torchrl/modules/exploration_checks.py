"""What a policy asks of the explorations it is given."""

from __future__ import annotations

from hdrqn_torchrl.modules.exploration import EpsilonGreedy


def exploration_or_greedy(exploration: EpsilonGreedy | None, name: str) -> EpsilonGreedy:
    """What an argument called ``name`` means: ``None`` is always greedy.

    Raises:
        ValueError: if it is something else.
    """
    if exploration is None:
        return EpsilonGreedy(0.0, 0.0)
    if not isinstance(exploration, EpsilonGreedy):
        raise ValueError(f"{name} must be an EpsilonGreedy or None, got {exploration!r}; None is always greedy.")
    return exploration


def check_two_schedules(sub: EpsilonGreedy, meta: EpsilonGreedy) -> None:
    """Refuses one exploration for two levels.

    Raises:
        ValueError: if they are the same.
    """
    if sub is meta:
        raise ValueError(
            f"meta_exploration must not be the sub level's, got one {type(meta).__name__} for both: its schedule would "
            "run twice as fast; give each level its own."
        )


def check_chooses_subgoals(exploration: EpsilonGreedy, name: str) -> None:
    """Refuses what is made for actions where subgoals are chosen.

    Raises:
        ValueError: if ``exploration``, the argument ``name``, is for actions only.
    """
    if exploration.for_actions_only:
        raise ValueError(
            f"{name} must be an EpsilonGreedy where subgoals are chosen, got {type(exploration).__name__}: a choice "
            "lasts for an option there, and is not made on the way to another subgoal; use EpsilonGreedy."
        )


def check_condition(exploration: EpsilonGreedy, name: str) -> None:
    """Refuses an exploration that depends on the subgoal pursued where none is.

    Raises:
        ValueError: if ``exploration``, the argument ``name``, is one.
    """
    if exploration.needs_subgoals:
        raise ValueError(
            f"{name} must not be a {type(exploration).__name__} where no subgoal is pursued, whose success it depends "
            "on; use EpsilonGreedy."
        )
