"""DQN and DRQN: one level, which learns from the task's total reward."""

from __future__ import annotations

from torchrl.envs import EnvBase
from torchrl.envs.transforms import InitTracker

from hdrqn_torchrl import keys
from hdrqn_torchrl.algorithms import presets
from hdrqn_torchrl.algorithms.base import (
    Algorithm,
    copies_of,
    make_recurrent_loss,
    require_settings,
    settings_named,
    stored_states,
)
from hdrqn_torchrl.algorithms.requirements import check_environment
from hdrqn_torchrl.algorithms.views import views_of
from hdrqn_torchrl.data import StepSelector
from hdrqn_torchrl.learning import Learner, LearnerSettings
from hdrqn_torchrl.modules import Architecture, EpsilonGreedy, SubController


def make_drqn(
    env: EnvBase,
    architecture: Architecture,
    *,
    total_frames: int | None = None,
    learner: LearnerSettings = presets.DRQN_LEARNER,
    exploration: EpsilonGreedy | None = None,
    gamma: float = 0.99,
    recurrent: bool = True,
    prediction_steps: int = 0,
    prediction_weight: float = 0.1,
) -> Algorithm:
    """Flat recurrent Q-learning (Hausknecht and Stone, 2015) on the task's total reward.

    Args:
        env: bare environment with batch size ``[N]``; of :mod:`hdrqn_torchrl.keys` it needs ``observation``, ``action``
            and ``reward``.
        architecture: networks.
        total_frames: environment frames of the whole training, in which the learning rates fall; ``None``: as the
            settings have it (``learning_rate_frames``).
        learner: how it learns.
        exploration: its schedule; ``None``: that of :mod:`~hdrqn_torchrl.algorithms.presets`.
        gamma: discount of one step.
        recurrent: ``False`` gives DQN.
        prediction_steps, prediction_weight: as in :func:`make_v3`.

    Raises:
        ValueError: if the environment lacks something.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> list(make_drqn(MultiGoalGridEnv(num_envs=4), compact_network()).learners)
        ['flat']
    """
    require_settings(learner=learner)
    learner, exploration = learner.lasting(total_frames), exploration or presets.flat_exploration()
    has = check_environment(env, architecture, builder="make_drqn" if recurrent else "make_dqn", levels=1)
    network = architecture.q_network(
        has.observation, num_actions=has.num_actions, recurrent=recurrent, prediction_steps=prediction_steps
    )
    policy = SubController(
        network, exploration, subgoal_key=None, init_key=keys.IS_INIT, mask_key=has.action_mask_key
    ).to(env.device)
    with settings_named("learner"):
        flat = Learner(
            policy,
            learner,
            extract=StepSelector(
                root_keys=[
                    *(keys.OBSERVATION, keys.ACTION, keys.IS_INIT),
                    *has.action_mask_keys,
                    *stored_states(policy, learner),
                ],
                next_keys=[keys.REWARD],
            ),
            loss=make_recurrent_loss(
                policy,
                learner,
                gamma=gamma,
                largest_return=has.task.largest_return,
                prediction_weight=prediction_weight,
            ),
            num_envs=has.num_envs,
            episode_len=has.task.max_steps,
        )
    return Algorithm(
        policy=policy,
        learners={"flat": flat},
        explorations={"flat": exploration},
        task=has.task,
        levels=views_of(has.levels, action_mask_key=has.action_mask_key),
        make_transforms=copies_of(InitTracker(), policy.make_tensordict_primer()),
    )


def make_dqn(
    env: EnvBase,
    architecture: Architecture,
    *,
    total_frames: int | None = None,
    learner: LearnerSettings = presets.DQN_LEARNER,
    exploration: EpsilonGreedy | None = None,
    gamma: float = 0.99,
) -> Algorithm:
    """Flat Q-learning without memory (Mnih et al., 2015) on the task's total reward.

    Args:
        env, architecture, total_frames, learner, exploration, gamma: as in :func:`make_drqn`.

    Raises:
        ValueError: if the environment lacks something.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> make_dqn(MultiGoalGridEnv(num_envs=4), compact_network()).policy.state_keys
        []
    """
    return make_drqn(
        env,
        architecture,
        total_frames=total_frames,
        learner=learner,
        exploration=exploration,
        gamma=gamma,
        recurrent=False,
    )
