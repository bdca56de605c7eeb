"""hDQN, hDRQNv1 and hDRQNv2: a meta-controller and a sub-controller, each with its own network and replay memory."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.transforms import InitTracker

from hdrqn_torchrl import keys
from hdrqn_torchrl.algorithms.base import Algorithm, copies_of, make_recurrent_loss, settings_named, stored_states
from hdrqn_torchrl.algorithms.requirements import check_environment
from hdrqn_torchrl.algorithms.views import views_of
from hdrqn_torchrl.data import (
    FROM_STARTS,
    HindsightOptions,
    OptionExtractor,
    OptionHistory,
    StepSelector,
    refresh_hidden,
    relabel_subgoals,
)
from hdrqn_torchrl.envs import Task
from hdrqn_torchrl.learning import Extract, Learner, LearnerSettings, PhaseOne, phase_monitors
from hdrqn_torchrl.modules import Architecture, EpsilonGreedy, HierarchicalPolicy, MetaController, SubController
from hdrqn_torchrl.transforms import IntrinsicReward, SubgoalTransform

LONGEST_HELD_EPISODE = 1_000
"""Steps of the longest episode whose options are stored all at once, when it is over."""


def make_hdrqn(
    env: EnvBase,
    architecture: Architecture,
    *,
    version: Literal["v1", "v2"] = "v2",
    sub: LearnerSettings = LearnerSettings(),  # noqa: B008
    meta: LearnerSettings = LearnerSettings(slice_len=1, capacity=50_000),  # noqa: B008
    sub_exploration: EpsilonGreedy | None = None,
    meta_exploration: EpsilonGreedy | None = None,
    phase_one: PhaseOne | None = None,
    gamma: float = 0.99,
    smdp_discount: bool = True,
    meta_input: Literal["hidden", "cell", "both"] = "hidden",
    meta_input_time: Literal["after_last_decision", "after_last_observation"] = "after_last_decision",
    refresh_hidden_steps: int | None = None,
    mask_reached: bool = True,
    repeatable_subgoals: bool = False,
    wrong_subgoal_reward: float = 0.0,
    hazard_reward: float = -1.0,
    max_option_steps: int | None = None,
    sub_hindsight: bool = False,
    meta_hindsight: bool = False,
    prediction_steps: int = 0,
    prediction_weight: float = 0.1,
    recurrent: bool = True,
) -> Algorithm:
    r"""Hierarchical deep recurrent Q-learning (Algorithm 1).

    Args:
        env: bare environment with batch size ``[N]``; of :mod:`hdrqn_torchrl.keys` it needs ``observation``,
            ``action``, ``reward``, ``extrinsic_reward`` and ``attained``; ``hazard``, ``available`` and ``success`` are
            used where they are.
        architecture: networks.
        version: what the meta-controller reads: ``"v1"`` the observation, ``"v2"`` the sub-controller's state.
        sub, meta: how each level learns.
        sub_exploration, meta_exploration: their schedules.
        phase_one: how long the sub level learns alone, with subgoals at random; ``None``: both learn from the start.
        gamma: discount of one step.
        smdp_discount: discount the option's return inside the option and what follows by :math:`\gamma^k`;
            ``False``: plain sum and :math:`\gamma`.
        meta_input: which part of the LSTM state v2 reads.
        meta_input_time: whether that state includes the observation in which the last option ended.
        refresh_hidden_steps: v2's states in the meta replay grow stale as the sub-controller learns. Given a number of
            steps, they are computed anew from the stored observations after options of up to so many steps (the step
            limit of an episode covers all). ``None`` keeps them as stored, like the paper.
        mask_reached: let the meta-controller choose only among subgoals not yet attained.
        repeatable_subgoals: whether subgoals can be attained again (then nothing is masked). Neither is asked of an
            environment that says itself what is worth choosing (``available``).
        wrong_subgoal_reward: intrinsic reward for attaining another subgoal than the chosen one.
        hazard_reward: intrinsic reward for meeting the hazard.
        max_option_steps: step limit of an option.
        sub_hindsight: learn about every subgoal from each sequence (:func:`~hdrqn_torchrl.data.relabel_subgoals`); a
            minibatch then holds ``sub.batch_size`` times the number of subgoals.
        meta_hindsight: learn from options as if they had been chosen for what they attained, too
            (:class:`~hdrqn_torchrl.data.HindsightOptions`).
        prediction_steps, prediction_weight: of the sub-controller's memory, as in :func:`make_v3`.
        recurrent: ``False`` gives hDQN (with ``version="v1"``).

    Raises:
        ValueError: if the environment lacks something, ``version`` or ``meta_input`` is unknown, v2 is asked for
            without recurrence, or hindsight with n-step targets or priorities (sub level) or with stored states.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> list(make_hdrqn(MultiGoalGridEnv(num_envs=4), compact_network()).learners)
        ['sub', 'meta']
    """
    if version not in ("v1", "v2"):
        raise ValueError(f"version must be 'v1' or 'v2', got {version!r}; v2 reads the sub-controller's state.")
    if version == "v2" and not recurrent:
        raise ValueError("version='v2' needs recurrent=True: it reads the LSTM state; use version='v1' for hDQN.")
    if meta_input_time not in ("after_last_decision", "after_last_observation"):
        raise ValueError(
            f"meta_input_time must be 'after_last_decision' or 'after_last_observation', got {meta_input_time!r}; "
            "the paper's Algorithm 1 has the former."
        )
    if sub_hindsight and sub.n_step > 1:
        raise ValueError(
            f"sub.n_step must be 1 with sub_hindsight=True, got {sub.n_step}: later actions pursued another subgoal; "
            "use sub.trace_decay, which looks on only while actions are the greedy ones for the subgoal in question."
        )
    if sub_hindsight and sub.priority_exponent is not None:
        raise ValueError(
            f"sub.priority_exponent must be None with sub_hindsight=True, got {sub.priority_exponent}: a sequence has "
            "an error for every subgoal it is told for, and one priority."
        )
    for level, settings, hindsight in (("sub", sub, sub_hindsight), ("meta", meta, meta_hindsight)):
        if settings.stored_state and hindsight:
            raise ValueError(
                f"{level}.stored_state must be False with {level}_hindsight=True: acting had its states on the way to "
                "the subgoal it pursued, not to the one that is learned about."
            )
    sub_exploration, meta_exploration = sub_exploration or EpsilonGreedy(), meta_exploration or EpsilonGreedy()
    has = check_environment(env, architecture, builder="make_hdrqn" if recurrent else "make_hdqn", levels=2)
    observation, num_actions, num_subgoals = has.observation, has.num_actions, has.num_subgoals
    masked = has.available_key is not None or (mask_reached and not repeatable_subgoals)
    mask_key = keys.SUBGOAL_MASK if masked else None
    meta_keys = _meta_input_keys(meta_input) if version == "v2" else [keys.OBSERVATION]
    meta_inputs = len(meta_keys) * architecture.hidden_size if version == "v2" else observation

    sub_controller = SubController(
        architecture.q_network(
            observation,
            num_actions=num_actions,
            num_conditions=num_subgoals,
            recurrent=recurrent,
            prediction_steps=prediction_steps,
        ),
        sub_exploration,
    )
    meta_controller = MetaController(
        architecture.q_network(meta_inputs, num_actions=num_subgoals, recurrent=recurrent),
        meta_exploration,
        input_keys=meta_keys,
        mask_key=mask_key,
    )
    reads_last = version == "v2" and meta_input_time == "after_last_observation"
    option_gamma = gamma if smdp_discount else 1.0
    refresh_steps, refresh = refresh_hidden_steps if version == "v2" else None, None
    if refresh_steps is not None:
        refresh = partial(refresh_hidden, sub_controller, refresh_steps, read_last_observation=reads_last)
    relabel, root_extra, next_extra = None, [], []
    intrinsic = IntrinsicReward(hazard=hazard_reward, wrong_subgoal=wrong_subgoal_reward)
    if sub_hindsight:
        relabel = partial(
            relabel_subgoals,
            num_subgoals=num_subgoals,
            rewards=intrinsic,
            hazard_key=has.hazard_key,
        )
        root_extra, next_extra = [keys.SUBGOAL_MASK], [keys.ATTAINED, *has.hazard_keys]
    policy = HierarchicalPolicy(meta_controller, sub_controller, read_last_observation=reads_last).to(env.device)
    starts = [keys.IS_INIT] if sub.sampling in FROM_STARTS else []
    with settings_named("sub"):
        sub_learner = Learner(
            sub_controller,
            sub,
            extract=StepSelector(
                root_keys=[
                    keys.OBSERVATION,
                    keys.ACTION,
                    keys.OPTION_INIT,
                    *starts,
                    *stored_states(sub_controller, sub),
                    *root_extra,
                ],
                next_keys=[
                    keys.INTRINSIC_REWARD,
                    keys.OPTION_DONE,
                    keys.OPTION_TERMINATED,
                    *next_extra,
                ],
                subgoal_key=keys.SUBGOAL,
            ),
            loss=make_recurrent_loss(
                sub_controller,
                sub,
                gamma=gamma,
                largest_return=intrinsic.largest_return,
                loss_keys={
                    "reward": keys.INTRINSIC_REWARD,
                    "done": keys.OPTION_DONE,
                    "terminated": keys.OPTION_TERMINATED,
                    "init": keys.OPTION_INIT,
                    "eligible": keys.ELIGIBLE if sub_hindsight else None,
                },
                prediction_weight=prediction_weight,
            ),
            num_envs=has.num_envs,
            episode_len=has.task.max_steps,
            refresh=relabel,
        )
    with settings_named("meta"):
        meta_learner = Learner(
            meta_controller,
            meta,
            extract=_option_extract(
                input_keys=meta_keys,
                mask_key=mask_key,
                at_end=partial(_read_last, sub_controller) if reads_last else None,
                state_keys=stored_states(meta_controller, meta),
                history_steps=refresh_steps,
                hindsight_gamma=option_gamma if meta_hindsight else None,
                max_held=_held_options(has.task, meta),
            ),
            loss=make_recurrent_loss(
                meta_controller,
                meta,
                gamma=gamma,
                largest_return=has.task.largest_extrinsic_return,
                loss_keys={
                    "action": keys.SUBGOAL,
                    "reward": keys.OPTION_RETURN,
                    "steps": keys.OPTION_STEPS if smdp_discount else None,
                    "action_mask": mask_key,
                },
            ),
            episode_len=None if has.task.max_steps is None else has.task.max_steps + 1,  # a row may end it
            refresh=refresh,
        )

    subgoals = SubgoalTransform(
        num_subgoals,
        gamma=option_gamma,
        max_option_steps=max_option_steps,
        hazard_reward=hazard_reward,
        wrong_subgoal_reward=wrong_subgoal_reward,
        repeatable=repeatable_subgoals,
        available_key=has.available_key,
        hazard_key=has.hazard_key,
    )
    primers = [controller.make_tensordict_primer() for controller in (sub_controller, meta_controller)]
    return Algorithm(
        policy=policy,
        learners={"sub": sub_learner, "meta": meta_learner},
        explorations={"sub": sub_exploration, "meta": meta_exploration},
        task=has.task,
        make_transforms=copies_of(InitTracker(), subgoals, *primers),
        levels=views_of(has.levels, masked=masked),
        monitors=phase_monitors(phase_one, num_subgoals, meta_exploration, meta_learner),
    )


make_hdqn = partial(make_hdrqn, version="v1", recurrent=False)
"""Two levels without memory (h-DQN; Kulkarni et al., 2016); see :func:`make_hdrqn`."""


def _option_extract(
    *,
    input_keys: list[str],
    mask_key: str | None,
    at_end: Callable[[TensorDictBase], TensorDictBase] | None,
    state_keys: list[NestedKey],
    history_steps: int | None,
    hindsight_gamma: float | None,
    max_held: int,
) -> Extract:
    """Where the meta level's transitions come from: options as they were or, given a discount, in hindsight, too."""

    def extractor(active_subgoal_key: str = keys.ACTIVE_SUBGOAL) -> OptionExtractor:
        return OptionExtractor(
            input_keys=input_keys,
            mask_key=mask_key,
            active_subgoal_key=active_subgoal_key,
            at_end=at_end,
            state_keys=state_keys,
            history=None if history_steps is None else OptionHistory(history_steps),
            max_held=max_held,
        )

    if hindsight_gamma is None:
        return extractor()
    return HindsightOptions(extractor(), extractor(keys.HINDSIGHT_SUBGOAL), gamma=hindsight_gamma, at_start=at_end)


def _held_options(task: Task, meta: LearnerSettings) -> int:
    """How many options of an episode wait for its end: all, unless it may be very long or have none.

    What waits can't be learned from yet. Sequences don't go over the border between two pieces of an episode, so these
    are several times as long.
    """
    if task.max_steps is not None and task.max_steps <= LONGEST_HELD_EPISODE:
        return LONGEST_HELD_EPISODE
    return 8 * ((meta.slice_len or 1) + meta.lookahead())


@torch.no_grad()
def _read_last(sub_controller: SubController, after: TensorDictBase) -> TensorDictBase:
    """Advances the LSTM state at the end of options by the observation that they ended in."""
    hidden, cell = sub_controller.advance(after)
    return after.set(sub_controller.hidden_key, hidden).set(sub_controller.cell_key, cell)


def _meta_input_keys(meta_input: str) -> list[str]:
    choices = {
        "hidden": [keys.SUB_HIDDEN],
        "cell": [keys.SUB_CELL],
        "both": [keys.SUB_HIDDEN, keys.SUB_CELL],
    }
    if meta_input not in choices:
        raise ValueError(f"meta_input must be one of {list(choices)}, got {meta_input!r}; the paper uses 'hidden'.")
    return choices[meta_input]
