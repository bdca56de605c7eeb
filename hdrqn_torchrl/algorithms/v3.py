"""hDRQNv3: one memory for the whole episode, with a head for each level."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from typing import Literal

from tensordict import NestedKey
from torchrl.envs import EnvBase
from torchrl.envs.transforms import InitTracker

from hdrqn_torchrl import keys
from hdrqn_torchrl.algorithms import presets
from hdrqn_torchrl.algorithms.base import (
    Algorithm,
    copies_of,
    largest_target,
    require_settings,
    settings_named,
    stored_states,
)
from hdrqn_torchrl.algorithms.books import make_books
from hdrqn_torchrl.algorithms.discovering import finding_subgoals, finds_subgoals
from hdrqn_torchrl.algorithms.requirements import Requirements, check_environment
from hdrqn_torchrl.algorithms.v3_sequences import check_learner, random_symmetry, symmetries_of, with_sequences
from hdrqn_torchrl.algorithms.views import views_of
from hdrqn_torchrl.data import StepSelector
from hdrqn_torchrl.discovery import DiscoverySettings, discovered_set
from hdrqn_torchrl.learning import Learner, LearnerSettings, PhaseOne, phase_monitors
from hdrqn_torchrl.modules import (
    AllSubgoalsNetwork,
    AllSubgoalsPolicy,
    Architecture,
    EpsilonGreedy,
    observation_predictor,
)
from hdrqn_torchrl.modules.sizes import check_size
from hdrqn_torchrl.objectives import AllSubgoalsLoss


def make_v3(
    env: EnvBase,
    architecture: Architecture,
    *,
    levels: int = 2,
    subgoals: Literal["given", "discovered"] = "given",
    discovery: DiscoverySettings = DiscoverySettings(),  # noqa: B008 (frozen)
    total_frames: int | None = None,
    learner: LearnerSettings = presets.V3_LEARNER,
    sub_exploration: EpsilonGreedy | None = None,
    meta_exploration: EpsilonGreedy | None = None,
    middle_exploration: EpsilonGreedy | None = None,
    phase_one: PhaseOne | None = None,
    memory_size: int = 128,
    head_size: int = 128,
    joint: bool = True,
    meta_learning_rate: float | None = None,
    sub_gamma: float = 0.9,
    meta_gamma: float = 0.95,
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
    symmetries: bool = False,
) -> Algorithm:
    """hDRQNv3, this project's own agent: one memory for the whole episode, and all subgoals learn from every step.

    Args:
        env: bare environment with batch size ``[N]``; of the entries in :mod:`hdrqn_torchrl.keys` it needs
            ``observation``, ``action``, ``reward``, ``extrinsic_reward`` and ``attained``; ``hazard``, ``available``,
            ``action_mask`` and ``success`` are used if present.
        architecture: provides the feature extractor.
        levels: number of levels. The agent pursues the last ``levels - 1`` sets of subgoals that the task states
            (:class:`~hdrqn_torchrl.envs.Task`). 1: a flat agent with the same memory and loss, which learns from the
            task's total reward, discounted by ``meta_gamma``; what is about subgoals and options is not read then.
        subgoals: ``"given"``: those of the task; ``"discovered"``: the agent finds them itself, in what it sees, does
            and is paid, and reads nothing that the environment says about subgoals (docs/discovery.md).
        discovery: how it finds them.
        total_frames: environment frames of the whole training, in which the learning rates fall; ``None``: as the
            settings have it (``learning_rate_frames``).
        learner: how it learns. Without ``stored_state``, ``sampling`` must be ``"episode_starts"`` or
            ``"whole_episodes"``, and ``slice_len`` should cover an episode; with it, shorter sequences may begin
            anywhere. ``slice_len=None``: the longest episode that the task states, up to 200 steps; if episodes may be
            longer or the task does not say, ``"episode_starts"`` is replaced by sequences of 32 steps from anywhere
            (``sampling="steps"``, ``stored_state=True``, ``burn_in=0.25``).
        sub_exploration, meta_exploration: exploration schedules; ``None``: those of
            :mod:`~hdrqn_torchrl.algorithms.presets`, where the sub level repeats random actions.
        middle_exploration: schedule of the levels in between, copied for each; ``None``: that of the meta level.
        phase_one: how long subgoals are chosen at random (the meta level learns meanwhile, because its head learns from
            every step); ``None``: never.
        memory_size: H, size of the LSTM.
        head_size: number of units in the hidden layer of each head.
        joint: whether the meta level also trains the memory; ``False``: it only reads it, and its head has its own
            optimiser.
        meta_learning_rate: learning rate of that optimiser, with the same schedule; ``None``:
            ``learner.learning_rate``.
        sub_gamma, meta_gamma, middle_gamma, trace_decay: see :class:`~hdrqn_torchrl.objectives.AllSubgoalsLoss`.
        all_subgoals, intra_option, hazard_reward, bonus_reward, prediction_weight: see there, too.
        wrong_subgoal_reward: reward of the levels below the top for attaining a subgoal other than the one pursued; one
            number for the farthest set, or one for each set from near to far. A penalty keeps the agent from collecting
            too early what it needs later (the grid tasks have -0.5). If one subgoal is needed for another, such as the
            key for the door, it blocks the only way; docs/v3.md has measurements.
        max_option_steps: step limit of options of the nearest subgoals.
        max_meta_target: largest possible return of the task; the meta level's targets are clipped to it. ``None``: what
            the task states, if anything; ``"unbounded"``: no clipping.
        prediction_steps: largest number of steps ahead for which the memory learns to predict the observation
            (:class:`~hdrqn_torchrl.modules.ObservationPredictor`); 0: no prediction.
        symmetries: whether the agent uses the ways to turn or mirror worlds that the task states
            (:class:`~hdrqn_torchrl.envs.Symmetry`): it learns from sequences as they would be there, too, and acts by
            the mean of its Q-values over all of them.

    Raises:
        ValueError: if the environment lacks something or states too few sets of subgoals for ``levels``; if sequences
            may begin in mid-episode without ``stored_state``, so that the memory would wrongly start empty; if
            ``joint=False`` or ``phase_one`` is given with one level; or if ``learner`` sets what the loss decides
            itself (``max_target``, ``trace_decay``, ``n_step``).

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> list(make_v3(MultiGoalGridEnv(num_envs=4), compact_network()).learners)
        ['joint']
    """
    require_settings(learner=learner)
    check_learner(learner)
    if joint and meta_learning_rate is not None:
        raise ValueError(f"meta_learning_rate must be None with joint=True, got {meta_learning_rate}; use joint=False.")
    if levels == 1 and not joint:
        raise ValueError("joint must be True with levels=1, got False: there is no meta level; use levels=2.")
    if phase_one is not None and levels == 1:
        raise ValueError("phase_one must be None with levels=1: it is about the choice of subgoals; use levels=2.")
    if bonus_reward and levels > 1:
        raise ValueError(
            f"bonus_reward must be 0 with levels={levels}, got {bonus_reward}; their critic already rewards subgoals."
        )
    finds = finds_subgoals(subgoals, levels=levels, phase_one=phase_one)
    own = discovered_set(discovery.max_subgoals) if finds else None
    has = check_environment(
        env, architecture, builder="make_v3", levels=levels, discovered=own, bonus=bool(bonus_reward)
    )
    learner = with_sequences(learner.lasting(total_frames), has.task)
    turns = symmetries_of(has, learner) if symmetries else ()
    sub_exploration = sub_exploration or presets.v3_sub_exploration()
    meta_exploration = meta_exploration or presets.meta_exploration()
    policy = AllSubgoalsPolicy(
        _make_network(has, architecture, memory_size, head_size, joint, prediction_steps),
        sub_exploration,
        meta_exploration if levels > 1 else None,
        middle_explorations=[deepcopy(middle_exploration or meta_exploration) for _ in has.subgoals[:-1]],
        subgoal_keys=[each.keys for each in has.subgoals],
        action_mask_key=has.action_mask_key,
        symmetries=turns,
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
            extract=_make_extract(loss, stored_states(policy, learner), has.event_keys),
            loss=loss,
            num_envs=has.num_envs,
            episode_len=has.task.max_steps,
            refresh=random_symmetry(turns, policy),
            refresh_reads=False,
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
    algorithm = Algorithm(
        policy=policy,
        learners={"joint": trained},
        explorations={level.name: each for level, each in zip(has.levels, explorations, strict=True)},
        task=has.task,
        make_transforms=copies_of(InitTracker(), *books, policy.make_tensordict_primer()),
        levels=views_of(has.levels, action_mask_key=has.action_mask_key),
        monitors=phase_monitors(phase_one, has.subgoals, explorations[1:]),
    )
    return finding_subgoals(algorithm, has, discovery) if finds else algorithm


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
        architecture.features(has.observation),
        num_actions=has.num_actions,
        num_subgoals=[len(each) for each in has.subgoals],
        hidden_size=memory_size,
        head_size=head_size,
        joint=joint,
        memory_span=architecture.memory_span,
        predictor=predictor,
    )


def _make_extract(loss: AllSubgoalsLoss, states: list[NestedKey], events: list[NestedKey]) -> StepSelector:
    """Stores what the loss reads, each observation only once: the next step's observation is the step's outcome."""
    after = [key[1] for key in loss.in_keys if isinstance(key, tuple) and key[0] == "next"]
    root = [key for key in loss.in_keys if not (isinstance(key, tuple) and key[0] == "next")]
    return StepSelector(
        root_keys=list(dict.fromkeys([*root, *states])),
        next_keys=[*(key for key in after if key not in (keys.DONE, keys.TERMINATED)), *events],
    )


def _largest_return(has: Requirements, bonus_reward: float) -> float:
    """The largest return of the top level, as far as the task states it."""
    if has.subgoals:
        return has.task.largest_extrinsic_return
    return math.inf if bonus_reward else has.task.largest_return
