"""hDRQNv1 and hDRQNv2: a controller for each level, each with its own network and replay memory."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import Literal

from torchrl.envs import EnvBase
from torchrl.envs.transforms import InitTracker

from hdrqn_torchrl.algorithms import presets
from hdrqn_torchrl.algorithms.base import Algorithm, copies_of, require_settings
from hdrqn_torchrl.algorithms.books import make_books
from hdrqn_torchrl.algorithms.discovering import finding_subgoals, finds_subgoals
from hdrqn_torchrl.algorithms.hdrqn_levels import LevelBuilder
from hdrqn_torchrl.algorithms.requirements import check_environment
from hdrqn_torchrl.algorithms.views import views_of
from hdrqn_torchrl.discovery import DiscoverySettings, discovered_set
from hdrqn_torchrl.learning import LearnerSettings, PhaseOne, phase_monitors
from hdrqn_torchrl.modules import Architecture, EpsilonGreedy, HierarchicalPolicy, MetaController, SubController
from hdrqn_torchrl.modules.sizes import check_size
from hdrqn_torchrl.transforms import penalties_of_sets


def make_hdrqn(
    env: EnvBase,
    architecture: Architecture,
    *,
    version: Literal["v1", "v2"] = "v2",
    levels: int = 2,
    subgoals: Literal["given", "discovered"] = "given",
    discovery: DiscoverySettings = DiscoverySettings(),  # noqa: B008 (frozen)
    total_frames: int | None = None,
    sub: LearnerSettings = presets.SUB_LEARNER,
    meta: LearnerSettings | None = None,
    middle: LearnerSettings | None = None,
    sub_exploration: EpsilonGreedy | None = None,
    meta_exploration: EpsilonGreedy | None = None,
    middle_exploration: EpsilonGreedy | None = None,
    phase_one: PhaseOne | None = None,
    gamma: float = 0.99,
    smdp_discount: bool = True,
    meta_input: Literal["hidden", "cell", "both"] = "hidden",
    meta_input_time: Literal["after_last_decision", "after_last_observation"] = "after_last_decision",
    refresh_hidden_steps: int | None = None,
    mask_reached: bool = True,
    repeatable_subgoals: bool | None = None,
    wrong_subgoal_reward: float | Sequence[float] = 0.0,
    hazard_reward: float = -1.0,
    max_option_steps: int | None = None,
    sub_hindsight: bool = False,
    meta_hindsight: bool = False,
    prediction_steps: int = 0,
    prediction_weight: float = 0.1,
    recurrent: bool = True,
) -> Algorithm:
    r"""Hierarchical deep recurrent Q-learning (Algorithm 1), with any number of levels.

    The paper has two. With more, each middle level chooses among a nearer set of subgoals of the task
    (:class:`~hdrqn_torchrl.envs.SubgoalSet`): it knows which subgoal the level above pursues, is paid that level's
    intrinsic reward, summed along its own options, and its memory restarts where that level chooses.

    Args:
        env: bare environment with batch size ``[N]``; of :mod:`hdrqn_torchrl.keys` it needs ``observation``,
            ``action``, ``reward``, ``extrinsic_reward`` and ``attained``; ``hazard``, ``available``, ``action_mask``
            and ``success`` are used where they are.
        architecture: networks.
        version: what levels that choose subgoals read: ``"v1"`` the observation, ``"v2"`` the state of the level below.
        levels: L; the agent pursues the farthest L - 1 sets of subgoals of the task.
        subgoals: ``"given"``: those of the task; ``"discovered"``: the agent finds them itself (docs/discovery.md), and
            learns them by relabelling what it has stored (``sub_hindsight=True``).
        discovery: how it finds them.
        total_frames: environment frames of the whole training, in which the learning rates fall; ``None``: as the
            settings have it (``learning_rate_frames``).
        sub, meta, middle: how each level learns; ``meta=None``: :data:`~hdrqn_torchrl.algorithms.presets.META_LEARNER`,
            for v1 with sequences of two options; ``middle=None``: like ``meta``.
        sub_exploration, meta_exploration, middle_exploration: their schedules; ``None``: those of
            :mod:`~hdrqn_torchrl.algorithms.presets`, and for middle levels the meta level's. Each middle level has a
            copy of its own.
        phase_one: how long the levels above the sub level choose at random and do not learn; ``None``: all levels
            learn from the start.
        gamma: discount of one step.
        smdp_discount: discount the option's return inside the option and what follows by :math:`\gamma^k`;
            ``False``: plain sum and :math:`\gamma`.
        meta_input: which part of the LSTM state v2 reads.
        meta_input_time: whether that state includes the observation in which the last option ended.
        refresh_hidden_steps: v2's states in the meta replay grow stale as the sub-controller learns. Given a number of
            steps, they are recomputed from the stored observations after options of up to this many steps (the step
            limit of an episode covers all). ``None`` keeps them as stored, like the paper.
        mask_reached: let the meta-controller choose only among subgoals not yet attained.
        repeatable_subgoals: whether the farthest subgoals can be attained again (then nothing is masked); ``None``: as
            the task states it. Neither is asked of an environment that says itself what is worth choosing
            (``available``).
        wrong_subgoal_reward: intrinsic reward for attaining another subgoal than the chosen one; one number for the
            farthest set, or one for each set from near to far.
        hazard_reward: intrinsic reward for meeting the hazard.
        max_option_steps: step limit of an option, among the nearest subgoals. The last step that an option may have
            teaches the sub level nothing, whatever it brings (with a limit of 1: only if it attains the subgoal).
        sub_hindsight: learn about every subgoal from each sequence (:func:`~hdrqn_torchrl.data.relabel_subgoals`); a
            minibatch then holds ``sub.batch_size`` times the number of subgoals.
        meta_hindsight: learn from options as if they had been chosen for what they attained, too
            (:class:`~hdrqn_torchrl.data.HindsightOptions`).
        prediction_steps, prediction_weight: of the sub-controller's memory, as in :func:`make_v3`.
        recurrent: ``False`` gives hDQN (with ``version="v1"``).

    Raises:
        ValueError: if the environment lacks something, ``version`` or ``meta_input`` is unknown, v1 is asked for with
            what only v2 reads (``meta_input``, ``meta_input_time``, ``refresh_hidden_steps``), v2 without recurrence,
            hindsight with n-step targets or priorities (sub level) or with stored states, or more than two levels with
            ``meta_hindsight`` or ``meta_input_time="after_last_observation"``.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> list(make_hdrqn(MultiGoalGridEnv(num_envs=4), compact_network()).learners)
        ['sub', 'meta']
    """
    _check_version(version, recurrent, meta_input, meta_input_time, refresh_hidden_steps)
    meta = presets.meta_learner(version) if meta is None else meta
    middle = meta if middle is None else middle
    require_settings(sub=sub, meta=meta, middle=middle)
    sub, meta, middle = (each.lasting(total_frames) for each in (sub, meta, middle))
    _check_levels(levels, meta_hindsight, meta_input_time)
    _check_hindsight(sub, meta, sub_hindsight, meta_hindsight)
    finds = finds_subgoals(subgoals, levels=levels, phase_one=phase_one, learns_all=sub_hindsight)
    own = discovered_set(discovery.max_subgoals) if finds else None
    builder = "make_hdrqn" if recurrent else "make_hdqn"
    has = check_environment(env, architecture, builder=builder, levels=levels, discovered=own)
    reads_last = version == "v2" and meta_input_time == "after_last_observation"
    build = LevelBuilder(
        has=has,
        architecture=architecture,
        version=version,
        recurrent=recurrent,
        gamma=gamma,
        smdp_discount=smdp_discount,
        meta_input=meta_input,
        reads_last=reads_last,
        refresh_hidden_steps=refresh_hidden_steps,
        mask_reached=mask_reached,
        repeatable_subgoals=repeatable_subgoals,
        hazard_reward=hazard_reward,
        penalties=tuple(penalties_of_sets(wrong_subgoal_reward, levels - 1)),
        max_option_steps=max_option_steps,
        sub_hindsight=sub_hindsight,
        meta_hindsight=meta_hindsight,
        prediction_steps=prediction_steps,
        prediction_weight=prediction_weight,
    )
    sub_exploration = sub_exploration or presets.sub_exploration()
    meta_exploration = meta_exploration or presets.meta_exploration()
    middles = [deepcopy(middle_exploration or meta_exploration) for _ in has.levels[1:-1]]
    sub_controller = build.sub_controller(sub_exploration)
    uppers = [
        build.upper_controller(index, exploration)
        for index, exploration in enumerate([*middles, meta_exploration], start=1)
    ]
    policy = HierarchicalPolicy(*reversed(uppers), sub_controller, read_last_observation=reads_last).to(env.device)
    settings = [*[middle] * len(middles), meta]
    learners = [
        build.sub_learner(sub_controller, sub),
        *(
            build.upper_learner(index, controller, sub_controller, each)
            for index, (controller, each) in enumerate(zip(uppers, settings, strict=True), start=1)
        ),
    ]
    books = make_books(
        has,
        gamma=gamma if smdp_discount else 1.0,
        max_option_steps=max_option_steps,
        hazard_reward=hazard_reward,
        wrong_subgoal_reward=wrong_subgoal_reward,
        repeatable=repeatable_subgoals,
    )
    controllers: list[SubController | MetaController] = [sub_controller, *uppers]
    primers = [controller.make_tensordict_primer() for controller in controllers]
    names, explorations = [level.name for level in has.levels], [sub_exploration, *middles, meta_exploration]
    algorithm = Algorithm(
        policy=policy,
        learners=dict(zip(names, learners, strict=True)),
        explorations=dict(zip(names, explorations, strict=True)),
        task=has.task,
        make_transforms=copies_of(InitTracker(), *books, *primers),
        levels=views_of(
            has.levels,
            action_mask_key=has.action_mask_key,
            masked=[each.mask_key is not None for each in uppers],
        ),
        monitors=phase_monitors(phase_one, has.subgoals, explorations[1:], learners[1:]),
    )
    return finding_subgoals(algorithm, has, discovery) if finds else algorithm


def _check_version(
    version: str, recurrent: bool, meta_input: str, meta_input_time: str, refresh_hidden_steps: int | None
) -> None:
    if version not in ("v1", "v2"):
        raise ValueError(f"version must be 'v1' or 'v2', got {version!r}; v2 reads the state of the level below.")
    if version == "v2" and not recurrent:
        raise ValueError(
            "recurrent must be True with version='v2', got False: it reads the LSTM state; use version='v1' for hDQN."
        )
    if meta_input not in ("hidden", "cell", "both"):
        raise ValueError(
            f"meta_input must be one of ['hidden', 'cell', 'both'], got {meta_input!r}; the paper uses 'hidden'."
        )
    if meta_input_time not in ("after_last_decision", "after_last_observation"):
        raise ValueError(
            f"meta_input_time must be 'after_last_decision' or 'after_last_observation', got {meta_input_time!r}; "
            "the paper's Algorithm 1 has the former."
        )
    of_v2 = {
        "meta_input": (meta_input, "hidden"),
        "meta_input_time": (meta_input_time, "after_last_decision"),
        "refresh_hidden_steps": (refresh_hidden_steps, None),
    }
    for name, (given, default) in of_v2.items():
        if version == "v1" and given != default:
            raise ValueError(
                f"{name} must be left at {default!r} with version='v1', got {given!r}: its levels read the "
                "observation, and no state of the level below; use version='v2'."
            )


def _check_levels(levels: int, meta_hindsight: bool, meta_input_time: str) -> None:
    check_size("levels", levels, 2)
    if levels < 2:
        raise ValueError(f"levels must be >= 2, got {levels}; use make_drqn for a flat agent.")
    if levels > 2 and meta_hindsight:
        raise ValueError(
            f"meta_hindsight must be False with levels={levels}, got True: an option that is relabelled would "
            "begin in the middle of another level's; use levels=2, or sub_hindsight."
        )
    if levels > 2 and meta_input_time == "after_last_observation":
        raise ValueError(
            f"meta_input_time must be 'after_last_decision' with levels={levels}, got {meta_input_time!r}; only the "
            "state that the meta level of two levels reads can be advanced."
        )


def _check_hindsight(sub: LearnerSettings, meta: LearnerSettings, sub_hindsight: bool, meta_hindsight: bool) -> None:
    if sub_hindsight and sub.n_step > 1:
        raise ValueError(
            f"sub.n_step must be 1 with sub_hindsight=True, got {sub.n_step}: later actions pursued another subgoal; "
            "use sub.trace_decay, which looks on only while actions are the greedy ones for the subgoal in question."
        )
    if sub_hindsight and sub.priority_exponent is not None:
        raise ValueError(
            f"sub.priority_exponent must be None with sub_hindsight=True, got {sub.priority_exponent}: a sequence has "
            "an error for every subgoal it is relabelled for, and one priority."
        )
    for level, settings, hindsight in (("sub", sub, sub_hindsight), ("meta", meta, meta_hindsight)):
        if settings.stored_state and hindsight:
            raise ValueError(
                f"{level}.stored_state must be False with {level}_hindsight=True: acting had its states on the way to "
                "the subgoal it pursued, not to the one that is learned about."
            )
