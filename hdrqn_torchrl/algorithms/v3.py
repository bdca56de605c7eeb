"""hDRQNv3: one memory for the whole episode, with a head for each level."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Literal

from tensordict import NestedKey
from torchrl.envs import EnvBase
from torchrl.envs.transforms import InitTracker

from hdrqn_torchrl import keys
from hdrqn_torchrl.algorithms.base import (
    Algorithm,
    copies_of,
    largest_target,
    settings_named,
    stored_states,
)
from hdrqn_torchrl.algorithms.books import make_books
from hdrqn_torchrl.algorithms.requirements import Requirements, check_environment
from hdrqn_torchrl.algorithms.views import views_of
from hdrqn_torchrl.data import FROM_STARTS, StepSelector
from hdrqn_torchrl.envs import Task
from hdrqn_torchrl.learning import Learner, LearnerSettings, PhaseOne, phase_monitors
from hdrqn_torchrl.modules import (
    AllSubgoalsNetwork,
    AllSubgoalsPolicy,
    Architecture,
    EpsilonGreedy,
    RepeatingEpsilonGreedy,
    observation_predictor,
)
from hdrqn_torchrl.modules.sizes import check_size
from hdrqn_torchrl.objectives import AllSubgoalsLoss

V3_LEARNER = LearnerSettings(
    slice_len=None,
    capacity=200_000,
    frames_per_update=20,
    warmup_frames=10_000,
    learning_rate=6e-4,
    tau=0.005,
    max_grad_norm=10.0,
    sampling="episode_starts",
)
"""Defaults of :func:`make_v3`."""
LONGEST_SEQUENCE = 200
"""Steps of the longest episode that v3 replays as a whole unless it is told to."""
SHORT_SEQUENCE = 32
"""Steps of v3's sequences that begin anywhere, unless it is told; so it learned Montezuma's Revenge."""


def make_v3(
    env: EnvBase,
    architecture: Architecture,
    *,
    levels: int = 2,
    learner: LearnerSettings = V3_LEARNER,
    sub_exploration: EpsilonGreedy | None = None,
    meta_exploration: EpsilonGreedy | None = None,
    middle_exploration: EpsilonGreedy | None = None,
    phase_one: PhaseOne | None = None,
    memory_size: int = 128,
    head_size: int = 128,
    joint: bool = True,
    meta_learning_rate: float | None = None,
    sub_gamma: float = 0.95,
    meta_gamma: float = 0.97,
    middle_gamma: float | None = None,
    trace_decay: float = 0.8,
    all_subgoals: bool = True,
    intra_option: bool = True,
    wrong_subgoal_reward: float | Sequence[float] = 0.0,
    hazard_reward: float = -1.0,
    bonus_reward: float = 0.0,
    max_option_steps: int | None = None,
    max_meta_target: float | Literal["unbounded"] | None = None,
    prediction_steps: int = 4,
    prediction_weight: float = 0.1,
) -> Algorithm:
    """hDRQNv3, this project's own agent: one memory for the whole episode, all subgoals learn from every step.

    Args:
        env: bare environment with batch size ``[N]``; of :mod:`hdrqn_torchrl.keys` it needs ``observation``,
            ``action``, ``reward``, ``extrinsic_reward`` and ``attained``; ``hazard``, ``available`` and ``success`` are
            used where they are.
        architecture: where the features come from.
        levels: how many levels choose: the agent pursues the last ``levels - 1`` sets of subgoals that the task states
            (:class:`~hdrqn_torchrl.envs.Task`). 1: a flat agent with the same memory and loss, which learns from the
            task's total reward.
        learner: how it learns. ``sampling`` must be ``"episode_starts"`` or ``"whole_episodes"``, then ``slice_len``
            should cover an episode; with ``stored_state``, sequences are shorter and begin anywhere.
            ``slice_len=None``: a whole episode as the task states it, up to 200 steps; where it may be longer, or the
            task does not say, ``"episode_starts"`` becomes sequences of 32 steps from anywhere (``sampling="steps"``,
            with ``stored_state`` and a ``burn_in`` of 0.25).
        sub_exploration, meta_exploration: schedules; the default sub level repeats random actions.
        middle_exploration: schedule of the levels between, a copy for each; ``None``: that of the meta level.
        phase_one: how long subgoals are chosen at random (the meta level learns meanwhile, as its head learns from
            every step); ``None``: not at all.
        memory_size: H, size of the LSTM.
        head_size: units of the heads' hidden layers.
        joint: whether the meta level trains the memory, too; ``False``: it reads the memory only, and its head has an
            optimiser of its own.
        meta_learning_rate: of that optimiser, following the same schedule; ``None``: ``learner.learning_rate``.
        sub_gamma, meta_gamma, middle_gamma, trace_decay, all_subgoals, intra_option, hazard_reward, bonus_reward,
            prediction_weight: see :class:`~hdrqn_torchrl.objectives.AllSubgoalsLoss`.
        wrong_subgoal_reward: of the levels below the top, for attaining another subgoal than the one in question; one
            number for the farthest set, or one for each set from near to far. Below 0 it keeps the agent from spoiling
            what comes later (the grid tasks have -0.5); but where one subgoal is needed for another, such as the key
            for the door, it forbids the only way: docs/v3.md has what was measured.
        max_option_steps: step limit of an option of the nearest subgoals.
        max_meta_target: largest return of the task there can be; the meta level's targets are cut off above it.
            ``None``: what the task states, if it states one; ``"unbounded"``: they are not cut off.
        prediction_steps: how many steps ahead, at most, the memory learns to predict what will be seen
            (:class:`~hdrqn_torchrl.modules.ObservationPredictor`); 0: not at all.

    Raises:
        ValueError: if the environment lacks something, or states fewer sets of subgoals than ``levels`` need; if
            ``learner.sampling`` begins in mid-episode without ``stored_state``, where the memory would start empty; or
            if ``learner`` has targets of its own (``max_target``, ``trace_decay``, ``n_step``).

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> list(make_v3(MultiGoalGridEnv(num_envs=4), compact_network()).learners)
        ['joint']
    """
    _check_learner(learner)
    if joint and meta_learning_rate is not None:
        raise ValueError(f"meta_learning_rate must be None with joint=True, got {meta_learning_rate}; use joint=False.")
    if bonus_reward and levels > 1:
        raise ValueError(
            f"bonus_reward must be 0 with levels={levels}, got {bonus_reward}: their critic rewards subgoals already."
        )
    has = check_environment(env, architecture, builder="make_v3", levels=levels)
    learner = _with_sequences(learner, has.task)
    sub_exploration, meta_exploration = sub_exploration or RepeatingEpsilonGreedy(), meta_exploration or EpsilonGreedy()
    policy = AllSubgoalsPolicy(
        _make_network(has, architecture, memory_size, head_size, joint, prediction_steps),
        sub_exploration,
        meta_exploration if levels > 1 else None,
        middle_explorations=[deepcopy(middle_exploration or meta_exploration) for _ in has.subgoals[:-1]],
        subgoal_keys=[each.keys for each in has.subgoals],
    ).to(env.device)
    flat = levels == 1
    loss = AllSubgoalsLoss(
        policy,
        sub_gamma=meta_gamma if flat else sub_gamma,
        meta_gamma=meta_gamma,
        middle_gamma=middle_gamma,
        trace_decay=trace_decay,
        wrong_subgoal_reward=wrong_subgoal_reward,
        hazard_reward=0.0 if has.hazard_key is None else hazard_reward,
        bonus_reward=bonus_reward,
        double=learner.double,
        all_subgoals=all_subgoals,
        intra_option=intra_option,
        max_meta_target=largest_target(max_meta_target, _largest_return(has, bonus_reward)),
        min_meta_target=-math.inf if flat else has.task.smallest_extrinsic_return,
        prediction_weight=prediction_weight,
        burn_in=learner.burn_in,
        train_exact_states=learner.train_exact_states,
        lookahead=1 + learner.lookahead(trace_decay),
        loss_function=learner.loss_function,
        stored_state=learner.stored_state,
    )
    if flat:
        loss.set_keys(extrinsic_reward=keys.REWARD)
    meta_rate = learner.learning_rate if meta_learning_rate is None else meta_learning_rate
    with settings_named("learner"):
        trained = Learner(
            policy,
            learner,
            extract=_make_extract(loss, stored_states(policy, learner)),
            loss=loss,
            num_envs=has.num_envs,
            episode_len=has.task.max_steps,
            separate=None if joint else {"network.meta_head": meta_rate / learner.learning_rate},
        )
    books = make_books(
        has,
        gamma=meta_gamma,
        max_option_steps=max_option_steps,
        hazard_reward=hazard_reward,
        wrong_subgoal_reward=wrong_subgoal_reward,
    )
    explorations = [sub_exploration, *policy.subgoal_explorations]
    return Algorithm(
        policy=policy,
        learners={"joint": trained},
        explorations={level.name: each for level, each in zip(has.levels, explorations, strict=True)},
        task=has.task,
        make_transforms=copies_of(InitTracker(), *books, policy.make_tensordict_primer()),
        levels=views_of(has.levels),
        monitors=phase_monitors(phase_one, has.num_subgoals, meta_exploration, None),
    )


def _check_learner(learner: LearnerSettings) -> None:
    """Refuses settings that mean something else for v3, or nothing."""
    if learner.sampling not in FROM_STARTS and not learner.stored_state:
        raise ValueError(
            f"sampling must be one of {FROM_STARTS} for v3 without stored_state, got {learner.sampling!r}: its memory "
            "lasts a whole episode and would start empty in the middle of one; or use stored_state=True."
        )
    if learner.trace_decay or learner.n_step > 1:
        raise ValueError(
            f"learner.trace_decay and n_step must be left at 0 and 1 for v3, got {learner.trace_decay} and "
            f"{learner.n_step}; its loss has a trace_decay of its own, an argument of v3."
        )
    if learner.max_target is not None:
        raise ValueError(
            f"max_target must be None for v3, got {learner.max_target}; its levels are bounded separately: those below "
            "the top by the reward for reaching the subgoal, the meta level by max_meta_target."
        )


def _make_network(
    has: Requirements,
    architecture: Architecture,
    memory_size: int,
    head_size: int,
    joint: bool,
    prediction_steps: int,
) -> AllSubgoalsNetwork:
    for name, size in (("memory_size", memory_size), ("head_size", head_size)):
        check_size(name, size, 128)
    check_size("prediction_steps", prediction_steps, "4, or 0 for no prediction", least=0)
    predictor = None
    if prediction_steps:
        predictor = observation_predictor(
            has.observation, memory_size, has.num_actions, prediction_steps, width=head_size
        )
    return AllSubgoalsNetwork(
        architecture.observation_features(has.observation),
        num_actions=has.num_actions,
        num_subgoals=[len(each) for each in has.subgoals],
        hidden_size=memory_size,
        head_size=head_size,
        joint=joint,
        predictor=predictor,
    )


def _make_extract(loss: AllSubgoalsLoss, states: list[NestedKey]) -> StepSelector:
    """Stores what the loss reads: an observation once, as the step that follows values what each led to."""
    after = [key[1] for key in loss.in_keys if isinstance(key, tuple) and key[0] == "next"]
    root = [key for key in loss.in_keys if not (isinstance(key, tuple) and key[0] == "next")]
    return StepSelector(
        root_keys=list(dict.fromkeys([*root, *states])),
        next_keys=[key for key in after if key not in (keys.DONE, keys.TERMINATED)],
    )


def _largest_return(has: Requirements, bonus_reward: float) -> float:
    """The largest return that the top level can collect, as far as the task states it."""
    if has.subgoals:
        return has.task.largest_extrinsic_return
    return math.inf if bonus_reward else has.task.largest_return


def _with_sequences(learner: LearnerSettings, task: Task) -> LearnerSettings:
    """The settings with sequences as the task needs them, unless they say themselves how long these are.

    Raises:
        ValueError: if whole episodes are asked for and may be very long.
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
            f"slice_len must be a number with sampling='whole_episodes' and episodes {length}, got None; or use "
            "sampling='steps' with stored_state=True."
        )
    warnings.warn(
        f"v3 learns from episodes {length} in sequences of {SHORT_SEQUENCE} steps that begin anywhere, from stored "
        "states (sampling='steps', stored_state=True, burn_in=0.25); give slice_len to have them begin where an "
        "episode does.",
        stacklevel=3,
    )
    return replace(learner, slice_len=SHORT_SEQUENCE, sampling="steps", stored_state=True, burn_in=0.25)
