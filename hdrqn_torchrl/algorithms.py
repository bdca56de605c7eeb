"""DQN, DRQN, hDQN, hDRQNv1, hDRQNv2 and hDRQNv3 as pure builders over the same parts.

A builder reads the specs of a bare environment and returns an :class:`Algorithm`: a policy, one learner per
level, and the transforms that the environment needs. The training loop never asks which one it runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, InitTracker, TransformedEnv

from hdrqn_torchrl import keys
from hdrqn_torchrl.data import (
    FROM_STARTS,
    HindsightOptions,
    OptionExtractor,
    OptionHistory,
    StepSelector,
    refresh_hidden,
    relabel_subgoals,
)
from hdrqn_torchrl.learner import Extract, Learner, LearnerSettings
from hdrqn_torchrl.modules import (
    AllSubgoalsNetwork,
    AllSubgoalsPolicy,
    Architecture,
    EpsilonGreedy,
    HierarchicalPolicy,
    MetaController,
    RepeatingEpsilonGreedy,
    SubController,
    observation_predictor,
)
from hdrqn_torchrl.objectives import AllSubgoalsLoss, RecurrentDQNLoss
from hdrqn_torchrl.transforms import SubgoalTransform

Controller = SubController | MetaController | AllSubgoalsPolicy

V3_LEARNER = LearnerSettings(
    slice_len=50,
    capacity=200_000,
    frames_per_update=20,
    warmup_frames=10_000,
    learning_rate=6e-4,
    tau=0.005,
    max_grad_norm=10.0,
    sampling="episode_starts",
)
"""Defaults of :func:`make_v3`, for episodes of 50 steps."""


@dataclass(frozen=True, kw_only=True)
class Algorithm:
    """A policy, its learners (one per level, by name) and the transforms its environment needs."""

    policy: TensorDictModuleBase
    learners: dict[str, Learner]
    explorations: dict[str, EpsilonGreedy]
    make_transforms: Callable[[], Compose]

    def transform(self, env: EnvBase) -> TransformedEnv:
        """The environment as this algorithm sees it."""
        return TransformedEnv(env, self.make_transforms())


def stored_states(network: Controller, settings: LearnerSettings) -> list[NestedKey]:
    """The recurrent states that are stored with the steps: all or none.

    Raises:
        ValueError: if ``settings.stored_state`` is asked of a network without memory.
    """
    if settings.stored_state and not network.state_keys:
        raise ValueError("stored_state must be False without recurrence, got True; such a network has no state.")
    return network.state_keys if settings.stored_state else []


def make_recurrent_loss(
    network: Controller,
    settings: LearnerSettings,
    *,
    gamma: float = 0.99,
    loss_keys: Mapping[str, NestedKey | None] | None = None,
    prediction_weight: float = 0.1,
) -> RecurrentDQNLoss:
    """The loss of one level, as its settings have it.

    Args:
        network: the controller that is trained.
        settings: how it learns.
        gamma: discount of one environment step.
        loss_keys: for :meth:`RecurrentDQNLoss.set_keys`, where they are not the default ones.
        prediction_weight: of the error of the network's predictor, if it has one.

    Raises:
        ValueError: if ``settings.stored_state`` is asked of a network without memory.
    """
    loss = RecurrentDQNLoss(
        network,
        gamma=gamma,
        burn_in=settings.burn_in,
        train_exact_states=settings.train_exact_states,
        loss_function=settings.loss_function,
        double=settings.double,
        max_target=settings.max_target,
        trace_decay=settings.trace_decay,
        n_step=settings.n_step,
        state_keys=stored_states(network, settings),
        predictor=network.network.predictor,
        prediction_weight=prediction_weight,
    )
    loss.set_keys(**(loss_keys or {}))
    return loss


def make_drqn(
    env: EnvBase,
    architecture: Architecture,
    *,
    learner: LearnerSettings = LearnerSettings(),  # noqa: B008 (frozen)
    exploration: EpsilonGreedy | None = None,
    gamma: float = 0.99,
    recurrent: bool = True,
    prediction_steps: int = 0,
    prediction_weight: float = 0.1,
) -> Algorithm:
    """Flat recurrent Q-learning (Hausknecht and Stone, 2015) on the task's total reward.

    Args:
        env: bare environment with batch size ``[N]`` and the keys of :mod:`hdrqn_torchrl.keys`.
        architecture: networks.
        learner: how it learns.
        exploration: its schedule.
        gamma: discount of one step.
        recurrent: ``False`` gives DQN.
        prediction_steps, prediction_weight: as in :func:`make_v3`.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> list(make_drqn(MultiGoalGridEnv(num_envs=4), compact_network()).learners)
        ['flat']
    """
    exploration = exploration or EpsilonGreedy()
    observation, num_actions = env.observation_spec[keys.OBSERVATION], env.action_spec.n
    network = architecture.q_network(
        observation, num_actions=num_actions, recurrent=recurrent, prediction_steps=prediction_steps
    )
    policy = SubController(network, exploration, subgoal_key=None, init_key=keys.IS_INIT).to(env.device)
    flat = Learner(
        policy,
        learner,
        extract=StepSelector(
            root_keys=[keys.OBSERVATION, keys.ACTION, keys.IS_INIT, *stored_states(policy, learner)],
            next_keys=[keys.OBSERVATION, keys.REWARD],
        ),
        loss=make_recurrent_loss(policy, learner, gamma=gamma, prediction_weight=prediction_weight),
        num_envs=env.batch_size[0],
    )
    return Algorithm(
        policy=policy,
        learners={"flat": flat},
        explorations={"flat": exploration},
        make_transforms=lambda: Compose(InitTracker(), policy.make_tensordict_primer()),
    )


make_dqn = partial(make_drqn, recurrent=False)
"""Flat Q-learning without memory (Mnih et al., 2015); see :func:`make_drqn`."""


def make_hdrqn(
    env: EnvBase,
    architecture: Architecture,
    *,
    version: Literal["v1", "v2"] = "v2",
    sub: LearnerSettings = LearnerSettings(),  # noqa: B008
    meta: LearnerSettings = LearnerSettings(slice_len=1, capacity=50_000),  # noqa: B008
    sub_exploration: EpsilonGreedy | None = None,
    meta_exploration: EpsilonGreedy | None = None,
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
        env: bare environment with batch size ``[N]`` and the keys of :mod:`hdrqn_torchrl.keys`.
        architecture: networks.
        version: what the meta-controller reads: ``"v1"`` the observation, ``"v2"`` the sub-controller's state.
        sub, meta: how each level learns.
        sub_exploration, meta_exploration: their schedules.
        gamma: discount of one step.
        smdp_discount: discount the option's return inside the option and what follows by :math:`\gamma^k`;
            ``False``: plain sum and :math:`\gamma`.
        meta_input: which part of the LSTM state v2 reads.
        meta_input_time: whether that state includes the observation in which the last option ended.
        refresh_hidden_steps: v2's states in the meta replay grow stale as the sub-controller learns. Given a number of
            steps, they are computed anew from the stored observations after options of up to so many steps (the step
            limit of an episode covers all). ``None`` keeps them as stored, like the paper.
        mask_reached: let the meta-controller choose only among subgoals not yet attained.
        repeatable_subgoals: whether subgoals can be attained again (then nothing is masked).
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
        ValueError: if ``version`` or ``meta_input`` is unknown, v2 is asked for without recurrence, or
            hindsight with n-step targets or priorities (sub level) or with stored states.

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
    observation, num_actions = env.observation_spec[keys.OBSERVATION], env.action_spec.n
    num_subgoals = env.observation_spec[keys.ATTAINED].shape[-1]
    mask_key = keys.SUBGOAL_MASK if mask_reached and not repeatable_subgoals else None
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
    if sub_hindsight:
        relabel = partial(
            relabel_subgoals,
            num_subgoals=num_subgoals,
            hazard_reward=hazard_reward,
            wrong_subgoal_reward=wrong_subgoal_reward,
        )
        root_extra, next_extra = [keys.SUBGOAL_MASK], [keys.ATTAINED, keys.HAZARD]
    policy = HierarchicalPolicy(meta_controller, sub_controller, read_last_observation=reads_last).to(env.device)
    starts = [keys.IS_INIT] if sub.sampling in FROM_STARTS else []
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
            next_keys=[keys.OBSERVATION, keys.INTRINSIC_REWARD, keys.OPTION_DONE, keys.OPTION_TERMINATED, *next_extra],
            subgoal_key=keys.SUBGOAL,
        ),
        loss=make_recurrent_loss(
            sub_controller,
            sub,
            gamma=gamma,
            loss_keys={
                "reward": keys.INTRINSIC_REWARD,
                "done": keys.OPTION_DONE,
                "terminated": keys.OPTION_TERMINATED,
                "init": keys.OPTION_INIT,
                "eligible": keys.ELIGIBLE if sub_hindsight else None,
            },
            prediction_weight=prediction_weight,
        ),
        num_envs=env.batch_size[0],
        refresh=relabel,
    )
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
        ),
        loss=make_recurrent_loss(
            meta_controller,
            meta,
            gamma=gamma,
            loss_keys={
                "action": keys.SUBGOAL,
                "reward": keys.OPTION_RETURN,
                "steps": keys.OPTION_STEPS if smdp_discount else None,
                "action_mask": mask_key,
            },
        ),
        refresh=refresh,
    )

    def make_transforms() -> Compose:
        subgoals = SubgoalTransform(
            num_subgoals,
            gamma=option_gamma,
            max_option_steps=max_option_steps,
            hazard_reward=hazard_reward,
            wrong_subgoal_reward=wrong_subgoal_reward,
            repeatable=repeatable_subgoals,
        )
        primers = [controller.make_tensordict_primer() for controller in (sub_controller, meta_controller)]
        return Compose(InitTracker(), subgoals, *primers)

    return Algorithm(
        policy=policy,
        learners={"sub": sub_learner, "meta": meta_learner},
        explorations={"sub": sub_exploration, "meta": meta_exploration},
        make_transforms=make_transforms,
    )


make_hdqn = partial(make_hdrqn, version="v1", recurrent=False)
"""Two levels without memory (h-DQN; Kulkarni et al., 2016); see :func:`make_hdrqn`."""


def make_v3(
    env: EnvBase,
    architecture: Architecture,
    *,
    learner: LearnerSettings = V3_LEARNER,
    sub_exploration: EpsilonGreedy | None = None,
    meta_exploration: EpsilonGreedy | None = None,
    memory_size: int = 128,
    head_size: int = 128,
    joint: bool = True,
    meta_learning_rate: float | None = None,
    sub_gamma: float = 0.95,
    meta_gamma: float = 0.97,
    trace_decay: float = 0.8,
    all_subgoals: bool = True,
    intra_option: bool = True,
    wrong_subgoal_reward: float = -0.5,
    hazard_reward: float = -1.0,
    max_option_steps: int | None = None,
    max_meta_target: float | None = None,
    prediction_steps: int = 4,
    prediction_weight: float = 0.1,
) -> Algorithm:
    """hDRQNv3, this project's own agent: one memory for the whole episode, all subgoals learn from every step.

    Args:
        env: bare environment with batch size ``[N]`` and the keys of :mod:`hdrqn_torchrl.keys`.
        architecture: where the features come from.
        learner: how it learns. ``sampling`` must be ``"episode_starts"`` or ``"whole_episodes"``, then ``slice_len``
            should cover an episode; with ``stored_state``, sequences are shorter and begin anywhere.
        sub_exploration, meta_exploration: schedules; the default sub level repeats random actions.
        memory_size: H, size of the LSTM.
        head_size: units of the heads' hidden layers.
        joint: whether the meta level trains the memory, too; ``False``: it reads the memory only, and its head has an
            optimiser of its own.
        meta_learning_rate: of that optimiser, following the same schedule; ``None``: ``learner.learning_rate``.
        sub_gamma, meta_gamma, trace_decay, all_subgoals, intra_option, wrong_subgoal_reward, hazard_reward,
            max_meta_target, prediction_weight: see :class:`~hdrqn_torchrl.objectives.AllSubgoalsLoss`.
        max_option_steps: step limit of an option.
        prediction_steps: how many steps ahead, at most, the memory learns to predict what will be seen
            (:class:`~hdrqn_torchrl.modules.ObservationPredictor`); 0: not at all.

    Raises:
        ValueError: if ``learner.sampling`` begins in mid-episode without ``stored_state``, where the memory would
            start empty; or if ``learner`` has targets of its own (``max_target``, ``trace_decay``, ``n_step``).

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> list(make_v3(MultiGoalGridEnv(num_envs=4), compact_network()).learners)
        ['joint']
    """
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
            f"max_target must be None for v3, got {learner.max_target}; its levels are bounded apart: the sub level by "
            "the reward for reaching the subgoal, the meta level by max_meta_target."
        )
    if joint and meta_learning_rate is not None:
        raise ValueError(f"meta_learning_rate must be None with joint=True, got {meta_learning_rate}; use joint=False.")
    meta_rate = learner.learning_rate if meta_learning_rate is None else meta_learning_rate
    observation, num_actions = env.observation_spec[keys.OBSERVATION], env.action_spec.n
    num_subgoals = env.observation_spec[keys.ATTAINED].shape[-1]
    predictor = None
    if prediction_steps:
        predictor = observation_predictor(observation, memory_size, num_actions, prediction_steps, width=head_size)
    network = AllSubgoalsNetwork(
        architecture.observation_features(observation),
        num_actions=num_actions,
        num_subgoals=num_subgoals,
        hidden_size=memory_size,
        head_size=head_size,
        joint=joint,
        predictor=predictor,
    )
    sub_exploration, meta_exploration = sub_exploration or RepeatingEpsilonGreedy(), meta_exploration or EpsilonGreedy()
    policy = AllSubgoalsPolicy(network, sub_exploration, meta_exploration).to(env.device)
    loss = AllSubgoalsLoss(
        policy,
        sub_gamma=sub_gamma,
        meta_gamma=meta_gamma,
        trace_decay=trace_decay,
        wrong_subgoal_reward=wrong_subgoal_reward,
        hazard_reward=hazard_reward,
        double=learner.double,
        all_subgoals=all_subgoals,
        intra_option=intra_option,
        max_meta_target=max_meta_target,
        prediction_weight=prediction_weight,
        burn_in=learner.burn_in,
        train_exact_states=learner.train_exact_states,
        loss_function=learner.loss_function,
        stored_state=learner.stored_state,
    )
    stored = StepSelector(
        root_keys=[
            keys.OBSERVATION,
            keys.PREVIOUS_ACTION,
            keys.ACTION,
            keys.IS_INIT,
            keys.OPTION_INIT,
            keys.SUBGOAL_MASK,
            *stored_states(policy, learner),
        ],
        next_keys=[keys.ATTAINED, keys.HAZARD, keys.EXTRINSIC_REWARD, keys.ACTIVE_SUBGOAL],
    )
    trained = Learner(
        policy,
        learner,
        extract=stored,
        loss=loss,
        lookahead=1,
        num_envs=env.batch_size[0],
        separate=None if joint else {"network.meta_head": meta_rate / learner.learning_rate},
    )

    def make_transforms() -> Compose:
        subgoals = SubgoalTransform(
            num_subgoals,
            gamma=meta_gamma,
            max_option_steps=max_option_steps,
            hazard_reward=hazard_reward,
            wrong_subgoal_reward=wrong_subgoal_reward,
        )
        return Compose(InitTracker(), subgoals, policy.make_tensordict_primer())

    return Algorithm(
        policy=policy,
        learners={"joint": trained},
        explorations={"sub": sub_exploration, "meta": meta_exploration},
        make_transforms=make_transforms,
    )


def _option_extract(
    *,
    input_keys: list[str],
    mask_key: str | None,
    at_end: Callable[[TensorDictBase], TensorDictBase] | None,
    state_keys: list[NestedKey],
    history_steps: int | None,
    hindsight_gamma: float | None,
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
        )

    if hindsight_gamma is None:
        return extractor()
    return HindsightOptions(extractor(), extractor(keys.HINDSIGHT_SUBGOAL), gamma=hindsight_gamma, at_start=at_end)


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
