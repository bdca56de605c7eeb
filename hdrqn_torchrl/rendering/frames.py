"""The record of one moment of an episode."""

from __future__ import annotations

from dataclasses import dataclass

from hdrqn_torchrl.envs.scene import Scene


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
        """Whether chance chose something other than the best."""
        return self.choice != self.best


@dataclass(frozen=True)
class Pursuit:
    """A subgoal in force.

    Attributes:
        level: name of the level that chose it.
        names: of the subgoals among which it was chosen.
        decision: Q-values and choice, from when the option began.
        steps: number of steps that the option has lasted.
    """

    level: str
    names: tuple[str, ...]
    decision: Decision
    steps: int = 0

    @property
    def name(self) -> str:
        """Name of the subgoal."""
        return self.names[self.decision.choice]


@dataclass(frozen=True)
class Score:
    """What an episode has brought so far.

    Attributes:
        reached: subgoals reached ``[G]``, of the farthest set.
        intrinsic: sum of r^in as actions are paid; ``None`` for flat agents.
        steps: steps of the episode.
        total: sum of the task's total reward, the episode's return.
        extrinsic: sum of r^ex.
        option_intrinsic: sum of r^in since the nearest option began.
    """

    reached: tuple[bool, ...]
    intrinsic: float | None
    steps: int = 0
    total: float = 0.0
    extrinsic: float = 0.0
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
        score: rewards and counts before this decision.
        action: Q-values of actions, and the action.
        pursuits: subgoals in force, from near to far; none for flat agents.
        event: what the step before did; empty if nothing of note.
        attained: subgoals that the step before attained ``[G]``, of the farthest set.
        outcome: how the episode ended; empty while it is played.
        success: whether it ended with the whole task completed.

    Examples:
        >>> from hdrqn_torchrl.algorithms import make_hdrqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> from hdrqn_torchrl.rendering import record_episodes
        >>> env = MultiGoalGridEnv(num_envs=1, max_steps=3)
        >>> agent = make_hdrqn(env, compact_network(8, (8,)))
        >>> first, *_, last = record_episodes(agent.transform(env), agent)
        >>> first.pursuits[0].names, first.starts_option, len(first.action.values)
        (('goal 1', 'goal 2'), True, 4)
        >>> last.score.steps, last.outcome
        (3, 'time is up')
    """

    scene: Scene
    episode: int
    episodes: int
    max_steps: int | None
    score: Score
    action: Decision
    pursuits: tuple[Pursuit, ...] = ()
    event: str = ""
    attained: tuple[bool, ...] = ()
    outcome: str = ""
    success: bool = False

    @property
    def subgoal(self) -> Decision | None:
        """Q-values and choice of the farthest subgoal; ``None`` for flat agents."""
        return self.pursuits[-1].decision if self.pursuits else None

    @property
    def starts_option(self) -> bool:
        """Whether a subgoal was chosen at this moment."""
        return any(pursuit.steps == 0 for pursuit in self.pursuits)
