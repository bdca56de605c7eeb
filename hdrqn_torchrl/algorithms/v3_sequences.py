"""The sequences that v3 learns from: what its learner's settings may say, and what suits a task."""

from __future__ import annotations

import warnings
from dataclasses import replace

from hdrqn_torchrl import keys
from hdrqn_torchrl.algorithms.requirements import Requirements
from hdrqn_torchrl.data import FROM_STARTS
from hdrqn_torchrl.envs import Symmetry, Task
from hdrqn_torchrl.learning import LearnerSettings, RandomSymmetry
from hdrqn_torchrl.modules import AllSubgoalsPolicy

LONGEST_SEQUENCE = 200
"""Longest episode, in steps, that v3 replays as a whole by default."""
SHORT_SEQUENCE = 32
"""Default length, in steps, of sequences that begin anywhere; v3 learned Montezuma's Revenge with it."""


def check_learner(learner: LearnerSettings) -> None:
    """Refuses settings that have no meaning for v3, or another one."""
    if learner.sampling not in FROM_STARTS and not learner.stored_state:
        raise ValueError(
            f"learner.sampling must be one of {FROM_STARTS} for v3 without stored_state, got {learner.sampling!r}: its "
            "memory lasts a whole episode and would start empty in mid-episode; use one of them, or stored_state=True."
        )
    if learner.trace_decay or learner.n_step > 1:
        raise ValueError(
            f"learner.trace_decay and n_step must be left at 0 and 1 for v3, got {learner.trace_decay} and "
            f"{learner.n_step}; use v3's own argument trace_decay."
        )
    if learner.max_target is not None:
        raise ValueError(
            f"learner.max_target must be None for v3, got {learner.max_target}; the meta level's targets are bounded "
            "by max_meta_target, those of the other levels by the reward for reaching the subgoal."
        )


def with_sequences(learner: LearnerSettings, task: Task) -> LearnerSettings:
    """The settings with a ``slice_len`` that suits the task, if they have none.

    Raises:
        ValueError: if ``sampling="whole_episodes"`` and episodes may be too long.
    """
    if learner.slice_len is not None:
        return learner
    if learner.sampling not in FROM_STARTS:
        return replace(learner, slice_len=SHORT_SEQUENCE)
    if task.max_steps is not None and task.max_steps <= LONGEST_SEQUENCE:
        return replace(learner, slice_len=task.max_steps)
    length = "of unknown length" if task.max_steps is None else f"of up to {task.max_steps} steps"
    if learner.sampling == "whole_episodes":
        raise ValueError(
            f"learner.slice_len must be a number with sampling='whole_episodes' and episodes {length}, got None; give "
            "one, or use sampling='steps' with stored_state=True."
        )
    warnings.warn(
        f"v3 learns from episodes {length} in sequences of {SHORT_SEQUENCE} steps that begin anywhere, from stored "
        "states (sampling='steps', stored_state=True, burn_in=0.25); give slice_len for sequences from the start of "
        "episodes.",
        stacklevel=3,
    )
    return replace(learner, slice_len=SHORT_SEQUENCE, sampling="steps", stored_state=True, burn_in=0.25)


def symmetries_of(has: Requirements, learner: LearnerSettings) -> tuple[Symmetry, ...]:
    """The ways to turn and mirror the task's worlds, if an agent may use them.

    Raises:
        ValueError: if the task states none, or those of other observations or actions; if sequences have states that
            were computed as worlds were; or if subgoals may be of places.
    """
    if has.finds_subgoals:
        raise ValueError(
            "symmetries must be False with subgoals='discovered', got True: what happens at a place is another event "
            "in a turned world."
        )
    if not has.task.symmetries:
        raise ValueError(
            "symmetries must be False for a task that states none, got True; an environment states them in its task."
        )
    if learner.stored_state:
        raise ValueError(
            "symmetries must be False with learner.stored_state=True, got True: the stored states are of what was seen "
            "as it was; use sequences from the start of episodes."
        )
    first = has.task.symmetries[0]
    stated, sizes = (len(first.places), len(first.actions)), (has.observation.shape[1:].numel(), has.num_actions)
    if stated != sizes:
        raise ValueError(
            f"symmetries must be of the observation's {sizes[0]} places and of {sizes[1]} actions, got a task that "
            f"states those of {stated[0]} and {stated[1]}; state them for what the agent sees and does."
        )
    return has.task.symmetries


def random_symmetry(symmetries: tuple[Symmetry, ...], policy: AllSubgoalsPolicy) -> RandomSymmetry | None:
    """Turns and mirrors the policy's sequences, if there are ways to."""
    if not symmetries:
        return None
    mask = policy.action_mask_key
    return RandomSymmetry(
        symmetries,
        observation_key=policy.observation_key,
        action_keys=[keys.ACTION, policy.previous_action_key],
        mask_keys=[] if mask is None else [mask],
        device=next(policy.parameters()).device,
    )
