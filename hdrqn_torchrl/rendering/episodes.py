"""Plays episodes and keeps for every step what explains it: world, view, subgoal, rewards, Q-values of both levels."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import EnvBase, ExplorationType

from hdrqn_torchrl import keys
from hdrqn_torchrl.algorithms import Algorithm
from hdrqn_torchrl.modules import EpsilonGreedy
from hdrqn_torchrl.rendering.scenes import Scene, scene_of
from hdrqn_torchrl.runs.isolation import isolated


@dataclass(frozen=True)
class Decision:
    """One epsilon-greedy choice: the Q-values, which of them were allowed, and what was chosen."""

    values: tuple[float, ...]
    allowed: tuple[bool, ...]
    choice: int

    @property
    def best(self) -> int:
        """The greedy choice."""
        among = [index for index, allowed in enumerate(self.allowed) if allowed] or range(len(self.values))
        return max(among, key=lambda index: self.values[index])

    @property
    def explores(self) -> bool:
        """Whether chance chose something else than the best."""
        return self.choice != self.best


@dataclass(frozen=True)
class Score:
    """What an episode has brought so far.

    Attributes:
        reached: subgoals reached ``[G]``.
        intrinsic: sum of r^in; ``None`` for flat agents.
        steps: steps of the episode.
        total: sum of the task's total reward, the episode's return.
        extrinsic: sum of r^ex.
        option_steps, option_intrinsic: steps and sum of r^in since the option began.
    """

    reached: tuple[bool, ...]
    intrinsic: float | None
    steps: int = 0
    total: float = 0.0
    extrinsic: float = 0.0
    option_steps: int = 0
    option_intrinsic: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One moment of a recorded episode: the world and the decision taken in it.

    The last frame of an episode has an ``outcome``; it shows the world after the last step and repeats the decision
    that led there.

    Attributes:
        scene: world and view.
        episode: counts from 1.
        episodes: how many are recorded.
        max_steps: step limit of an episode, if there is one.
        score: what came in before this decision.
        action: Q^S (or Q of a flat agent) and the action.
        subgoal: Q^M and the subgoal, from when the option began; ``None`` for flat agents.
        starts_option: whether the subgoal was chosen in this very moment.
        event: what the step before did; empty if nothing worth telling.
        outcome: how the episode ended; empty while it is played.
        success: whether it ended with the whole task completed.
    """

    scene: Scene
    episode: int
    episodes: int
    max_steps: int | None
    score: Score
    action: Decision
    subgoal: Decision | None
    starts_option: bool
    event: str = ""
    outcome: str = ""
    success: bool = False


@torch.no_grad()
def record_episodes(
    env: EnvBase, algorithm: Algorithm, *, episodes: int = 1, seed: int = 0, epsilon: float = 0.0
) -> list[Frame]:
    """Plays episodes one after another in one world. The same seed gives the same frames.

    Args:
        env: environment as the algorithm sees it (``algorithm.transform(...)``), batch size ``[1]``.
        algorithm: whose policy plays.
        episodes: number of episodes, at least 1.
        seed: seed of worlds and exploration.
        epsilon: probability of a random choice, at both levels.

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
    if not 0.0 <= epsilon <= 1.0:
        raise ValueError(f"epsilon must lie in [0, 1], got {epsilon}; 0 plays greedily.")
    exploration_type = ExplorationType.RANDOM if epsilon > 0 else ExplorationType.DETERMINISTIC
    with (
        isolated(env, algorithm.policy, seed=seed, exploration_type=exploration_type),
        _fixed_epsilon(algorithm.explorations, epsilon),
        _listening(algorithm.explorations) as heard,
    ):
        rounds = (_play(env, algorithm.policy, heard, number + 1, episodes) for number in range(episodes))
        return [frame for played in rounds for frame in played]


def _play(env: EnvBase, policy: nn.Module, heard: dict[str, Decision], episode: int, episodes: int) -> Iterator[Frame]:
    """The frames of one episode."""
    base, tensordict = getattr(env, "base_env", env), env.reset()
    hierarchical = keys.OPTION_INIT in tensordict
    score = Score((False,) * tensordict[keys.ATTAINED].shape[-1], intrinsic=0.0 if hierarchical else None)
    subgoal: Decision | None = None
    starts, event = False, ""
    while True:
        policy(tensordict)
        if hierarchical and (starts := bool(tensordict[keys.OPTION_INIT])):
            subgoal, score = heard["meta"], replace(score, option_steps=0, option_intrinsic=0.0)
        action = heard["sub" if hierarchical else "flat"]
        frame = Frame(
            scene=scene_of(base, subgoal=_choice(subgoal), action=action.choice),
            episode=episode,
            episodes=episodes,
            max_steps=getattr(base, "max_steps", None),
            score=score,
            action=action,
            subgoal=subgoal,
            starts_option=starts,
            event=event,
        )
        yield frame
        tensordict = env.step(tensordict)
        after = tensordict["next"][0]
        score, event = _add(score, after), _tell(frame.scene, after)
        if after[keys.DONE]:
            yield _last(replace(frame, score=score, event=event), base, after)
            return
        tensordict = env.step_mdp(tensordict)


def _last(frame: Frame, base: EnvBase, after: TensorDictBase) -> Frame:
    """The end of an episode: the world after the last step."""
    success = bool(after[keys.SUCCESS])
    return replace(
        frame,
        scene=scene_of(base, subgoal=_choice(frame.subgoal)),
        starts_option=False,
        outcome=frame.scene.outcome(success, bool(after[keys.TERMINATED])),
        success=success,
    )


def _choice(decision: Decision | None) -> int | None:
    return None if decision is None else decision.choice


def _add(score: Score, after: TensorDictBase) -> Score:
    """The score after one more step (what the environment wrote, ``[]``)."""
    score = replace(
        score,
        steps=score.steps + 1,
        total=score.total + after[keys.REWARD].item(),
        extrinsic=score.extrinsic + after[keys.EXTRINSIC_REWARD].item(),
        option_steps=score.option_steps + 1,
        reached=tuple(a or b for a, b in zip(score.reached, after[keys.ATTAINED].tolist(), strict=True)),
    )
    if score.intrinsic is None:
        return score
    reward = after[keys.INTRINSIC_REWARD].item()
    return replace(score, intrinsic=score.intrinsic + reward, option_intrinsic=score.option_intrinsic + reward)


def _tell(scene: Scene, after: TensorDictBase) -> str:
    """What a step did, in a few words."""
    told = []
    for name, attained in zip(scene.subgoal_names, after[keys.ATTAINED].tolist(), strict=True):
        if attained:
            told.append(f"{name} reached, rᵉˣ {after[keys.EXTRINSIC_REWARD].item():+.2f}")
    if after[keys.HAZARD]:
        told.append(scene.hazard)
    if keys.OPTION_DONE in after and after[keys.OPTION_DONE] and not (after[keys.SUBGOAL_REACHED] | after[keys.DONE]):
        told.append("option given up")
    return ", ".join(told)


@contextmanager
def _fixed_epsilon(explorations: dict[str, EpsilonGreedy], epsilon: float) -> Iterator[None]:
    """Sets the epsilon of every level, and sets it back."""
    kept = {name: exploration.fixed for name, exploration in explorations.items()}
    try:
        for exploration in explorations.values():
            exploration.fixed = epsilon
        yield
    finally:
        for name, exploration in explorations.items():
            exploration.fixed = kept[name]


@contextmanager
def _listening(explorations: dict[str, EpsilonGreedy]) -> Iterator[dict[str, Decision]]:
    """The latest decision of every level: whatever the algorithm, each goes through a method of its exploration."""
    heard: dict[str, Decision] = {}
    with ExitStack() as stack:
        for level, exploration in explorations.items():
            for method in ("forward",):
                if hasattr(exploration, method):
                    setattr(exploration, method, _overheard(getattr(exploration, method), heard, level))
                    stack.callback(delattr, exploration, method)
        yield heard


def _overheard(choose: Callable, heard: dict[str, Decision], level: str) -> Callable:
    """``choose``, which also notes its Q-values, mask and choice."""
    signature = inspect.signature(choose)

    def choose_and_note(*args, **kwargs) -> Any:
        result = choose(*args, **kwargs)
        given = signature.bind(*args, **kwargs).arguments
        values, mask = given["values"][0], given.get("mask")
        allowed = torch.ones_like(values, dtype=torch.bool) if mask is None else mask[0]
        choice = result[0] if isinstance(result, tuple) else result
        heard[level] = Decision(tuple(values.tolist()), tuple(allowed.tolist()), int(choice[0]))
        return result

    return choose_and_note
