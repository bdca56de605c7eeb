"""The option books of an agent: one :class:`~hdrqn_torchrl.transforms.SubgoalTransform` for each set of subgoals."""

from __future__ import annotations

from collections.abc import Sequence

from hdrqn_torchrl import keys
from hdrqn_torchrl.algorithms.requirements import Requirements
from hdrqn_torchrl.transforms import SubgoalTransform, penalties_of_sets


def make_books(
    has: Requirements,
    *,
    gamma: float,
    max_option_steps: int | None = None,
    hazard_reward: float = -1.0,
    wrong_subgoal_reward: float | Sequence[float] = 0.0,
    repeatable: bool | None = None,
) -> list[SubgoalTransform]:
    """The books in their order in the environment, from far to near.

    The end of a farther option ends the nearer one, and options of a nearer set collect the intrinsic reward of the
    farther option.

    Args:
        has: what the environment has.
        gamma: discount inside options.
        max_option_steps: step limit of the nearest options.
        hazard_reward: the critic's reward for the hazard.
        wrong_subgoal_reward: the critic's penalties (:func:`~hdrqn_torchrl.transforms.penalties_of_sets`).
        repeatable: whether subgoals of the farthest set can be attained again; ``None``: as the task states.
    """
    penalties = penalties_of_sets(wrong_subgoal_reward, len(has.subgoals))
    books: list[SubgoalTransform] = []
    above: keys.OptionKeys | None = None
    levels = zip(has.subgoals, has.available_keys, penalties, strict=True)
    for index, (subgoals, available_key, penalty) in reversed(list(enumerate(levels))):
        names = subgoals.keys
        is_top = above is None
        books.append(
            SubgoalTransform(
                len(subgoals),
                prefix=subgoals.prefix,
                upper_done_key=None if above is None else above.option_done,
                upper_terminated_key=None if above is None else above.option_terminated,
                gamma=gamma,
                max_option_steps=max_option_steps if index == 0 else None,
                hazard_reward=hazard_reward,
                wrong_subgoal_reward=penalty,
                repeatable=subgoals.repeatable if repeatable is None or not is_top else repeatable,
                available_key=available_key,
                hazard_key=has.hazard_key,
                extrinsic_reward_key=keys.EXTRINSIC_REWARD if above is None else above.intrinsic_reward,
            )
        )
        above = names
    return books
