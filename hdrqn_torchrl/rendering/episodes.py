"""Plays episodes and records what explains every step: world, view, rewards, and the Q-values of every level."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.envs import EnvBase, ExplorationType

from hdrqn_torchrl import keys
from hdrqn_torchrl.algorithms import Algorithm, LevelView
from hdrqn_torchrl.envs import task_of
from hdrqn_torchrl.modules import EpsilonGreedy, writing_values
from hdrqn_torchrl.rendering.frames import Decision, Frame, Pursuit, Score
from hdrqn_torchrl.rendering.scenes import scene_of, subgoal_names
from hdrqn_torchrl.runs.evaluation import LONGEST_EPISODE
from hdrqn_torchrl.runs.isolation import isolated


@torch.no_grad()
def record_episodes(
    env: EnvBase,
    algorithm: Algorithm,
    *,
    episodes: int = 1,
    seed: int = 0,
    epsilon: float = 0.0,
    max_steps: int | None = None,
) -> list[Frame]:
    """Plays episodes one after another in one world. The same seed gives the same frames.

    Args:
        env: environment as the algorithm sees it (``algorithm.transform(...)``), batch size ``[1]``.
        algorithm: whose policy plays.
        episodes: number of episodes, at least 1.
        seed: seed of worlds and exploration.
        epsilon: probability of a random choice, at every level.
        max_steps: steps after which an episode is cut off; ``None``: as many as the task says, or 10,000.

    Returns:
        One frame for each step and one more for the end of each episode.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> from hdrqn_torchrl.algorithms import make_hdrqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> env = MultiGoalGridEnv(num_envs=1, max_steps=5)
        >>> agent = make_hdrqn(env, compact_network())
        >>> frames = record_episodes(agent.transform(env), agent, epsilon=0.1)
        >>> len(frames[0].action.values), len(frames[0].subgoal.values)
        (4, 2)
    """
    if env.batch_size != (1,):
        raise ValueError(f"env must have batch size [1], got {list(env.batch_size)}; build it with num_envs=1.")
    if episodes < 1:
        raise ValueError(f"episodes must be >= 1, got {episodes}; 3 show most of what an agent does.")
    if max_steps is not None and max_steps < 1:
        raise ValueError(f"max_steps must be >= 1 or None, got {max_steps}; None plays episodes to their end.")
    if not 0.0 <= epsilon <= 1.0:
        raise ValueError(f"epsilon must lie in [0, 1], got {epsilon}; 0 plays greedily.")
    if not algorithm.levels:
        raise ValueError("algorithm must name its levels to be watched, got none; give it levels=views_of(...).")
    exploration_type = ExplorationType.RANDOM if epsilon > 0 else ExplorationType.DETERMINISTIC
    with (
        isolated(env, algorithm.policy, seed=seed, exploration_type=exploration_type),
        _fixed_epsilon(algorithm.explorations, epsilon),
        writing_values(algorithm.policy),
    ):
        rounds = (_play(env, algorithm, number + 1, episodes, max_steps) for number in range(episodes))
        return [frame for played in rounds for frame in played]


def _play(env: EnvBase, algorithm: Algorithm, episode: int, episodes: int, max_steps: int | None) -> Iterator[Frame]:
    """The frames of one episode."""
    base, tensordict = getattr(env, "base_env", env), env.reset()
    task, draws_subgoals = task_of(env), _draws_subgoals(base, algorithm)
    longest = max_steps or task.max_steps or LONGEST_EPISODE
    own, *above = algorithm.levels
    score = Score((False,) * len(_attained(tensordict[0])), intrinsic=None if own.reward_key is None else 0.0)
    pursuits: tuple[Pursuit, ...] = ()
    event, attained = "", score.reached
    for step in range(longest):
        algorithm.policy(tensordict)
        now = tensordict[0]
        pursuits = _pursue(above, now, pursuits)
        if pursuits and pursuits[0].steps == 0:
            score = replace(score, option_intrinsic=0.0)
        action = _decision(own, now)
        frame = Frame(
            scene=scene_of(
                base,
                subgoal=pursuits[-1].decision.choice if draws_subgoals else None,
                action=action.choice,
                observation=now.get(keys.OBSERVATION, None),
            ),
            episode=episode,
            episodes=episodes,
            max_steps=task.max_steps,
            score=score,
            action=action,
            pursuits=pursuits,
            event=event,
            attained=attained,
        )
        yield frame
        tensordict = env.step(tensordict)
        after = tensordict["next"][0]
        pursuits = tuple(replace(pursuit, steps=pursuit.steps + 1) for pursuit in pursuits)
        score, event, attained = _add(score, own, after), _tell(frame, above, after), tuple(_attained(after))
        if after[keys.DONE] or step + 1 == longest:
            success = _happened(after, task.success)
            frame = replace(frame, score=score, event=event, attained=attained, pursuits=pursuits, success=success)
            subgoal = pursuits[-1].decision.choice if draws_subgoals else None
            yield _last(frame, base, subgoal, after)
            return
        tensordict = env.step_mdp(tensordict)


def _pursue(above: Sequence[LevelView], now: TensorDictBase, before: Sequence[Pursuit]) -> tuple[Pursuit, ...]:
    """The subgoals in force, those chosen in this very step ``[]`` included."""
    return tuple(
        Pursuit(view.name, tuple(view.choice_names), _decision(view, now)) if now[view.init_key] else before[place]
        for place, view in enumerate(above)
    )


def _decision(view: LevelView, now: TensorDictBase) -> Decision:
    """What a level chose in one step ``[]``, and by which Q-values."""
    values = now[view.value_key]
    allowed = torch.ones_like(values, dtype=torch.bool) if view.mask_key is None else now[view.mask_key]
    return Decision(tuple(values.tolist()), tuple(allowed.tolist()), int(now[view.choice_key]))


def _last(frame: Frame, base: EnvBase, subgoal: int | None, after: TensorDictBase) -> Frame:
    """The end of an episode: the world after the last step."""
    return replace(
        frame,
        scene=scene_of(base, subgoal=subgoal, observation=after.get(keys.OBSERVATION, None)),
        outcome=frame.scene.outcome(frame.success, bool(after[keys.TERMINATED])),
    )


def _draws_subgoals(base: EnvBase, algorithm: Algorithm) -> bool:
    """Whether the agent's farthest subgoals are those that the bare environment draws; a critic may have others."""
    return len(algorithm.levels) > 1 and algorithm.levels[-1].choice_names == subgoal_names(base, task_of(base))


def _add(score: Score, own: LevelView, after: TensorDictBase) -> Score:
    """The score after one more step (what the environment wrote, ``[]``)."""
    score = replace(
        score,
        steps=score.steps + 1,
        total=score.total + after[keys.REWARD].item(),
        extrinsic=score.extrinsic + _extrinsic_reward(after),
        reached=tuple(a or b for a, b in zip(score.reached, _attained(after), strict=True)),
    )
    if score.intrinsic is None:
        return score
    reward = after[own.reward_key].item()
    return replace(score, intrinsic=score.intrinsic + reward, option_intrinsic=score.option_intrinsic + reward)


def _tell(frame: Frame, above: Sequence[LevelView], after: TensorDictBase) -> str:
    """What a step did, in a few words."""
    told = []
    names = frame.pursuits[-1].names if frame.pursuits else frame.scene.subgoal_names
    for name, attained in zip(names, _attained(after), strict=False):
        if attained:
            told.append(f"{name} reached, rᵉˣ {_extrinsic_reward(after):+.2f}")
    if _happened(after, keys.HAZARD):
        told.append(frame.scene.hazard)
    for view, pursuit in zip(above[:-1], frame.pursuits[:-1], strict=True):
        if after[view.reached_key]:
            told.append(f"{pursuit.name} reached")
    if above and after[keys.OPTION_DONE] and not (after[keys.SUBGOAL_REACHED] | after[keys.DONE]):
        told.append("option given up")
    return ", ".join(told)


def _attained(after: TensorDictBase) -> list[bool]:
    """Of the farthest set; none where the environment has no subgoals."""
    return after[keys.ATTAINED].tolist() if keys.ATTAINED in after else []


def _extrinsic_reward(after: TensorDictBase) -> float:
    """The task's reward where it has no other."""
    return after[keys.EXTRINSIC_REWARD if keys.EXTRINSIC_REWARD in after else keys.REWARD].item()


def _happened(after: TensorDictBase, key: NestedKey) -> bool:
    """Whether a flag is set that not every environment has."""
    return key in after and bool(after[key])


@contextmanager
def _fixed_epsilon(explorations: dict[str, EpsilonGreedy], epsilon: float) -> Iterator[None]:
    """Sets the epsilon of every level, and restores it."""
    kept = {name: exploration.fixed for name, exploration in explorations.items()}
    try:
        for exploration in explorations.values():
            exploration.fixed = epsilon
        yield
    finally:
        for name, exploration in explorations.items():
            exploration.fixed = kept[name]
