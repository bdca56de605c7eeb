"""How an agent finds its subgoals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from torchrl.data import TensorSpec

from hdrqn_torchrl.discovery.changes import make_change_detector, sizes_of
from hdrqn_torchrl.discovery.critic import EventCritic
from hdrqn_torchrl.discovery.events import EventSelection
from hdrqn_torchrl.discovery.random_choice import RandomChanges, RandomSelection
from hdrqn_torchrl.discovery.selection import Selection
from hdrqn_torchrl.discovery.table import SubgoalTable
from hdrqn_torchrl.modules.sizes import check_size

Choice = Literal["useful", "random_events", "random_changes"]


@dataclass(frozen=True, kw_only=True)
class DiscoverySettings:
    """When subgoals are looked for, and how many there may be.

    Args:
        max_subgoals: number of slots; a slot that is free costs a head and nothing else.
        warmup_frames: environment frames in which the agent learns how its movements change what it sees; what was
            stored meanwhile is forgotten, as its events are unknown.
        discovery_frames: frames between two looks for subgoals.
        until_frames: frames after which the set stays as it is; ``None``: never, as rewards may come late.
        choice: ``"useful"``: events that matter. For controls: ``"random_events"``, drawn among all events, and
            ``"random_changes"``, drawn among all changes of what is seen, even those that movements explain.
        random_subgoals: number of subgoals that are drawn; ``None``: ``max_subgoals``.

    Raises:
        ValueError: if a value breaks its rule.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> spec = MultiGoalGridEnv(num_envs=2).observation_spec["observation"]
        >>> critic, selection = DiscoverySettings(max_subgoals=4).make(spec, num_actions=4)
        >>> list(critic.names)
        ['explore', 'free 1', 'free 2', 'free 3', 'free 4']
    """

    max_subgoals: int = 8
    warmup_frames: int = 10_000
    discovery_frames: int = 20_000
    until_frames: int | None = None
    choice: Choice = "useful"
    random_subgoals: int | None = None

    def __post_init__(self) -> None:
        for name, usual in (("max_subgoals", 8), ("warmup_frames", 10_000), ("discovery_frames", 20_000)):
            check_size(name, getattr(self, name), usual)
        if self.until_frames is not None:
            check_size("until_frames", self.until_frames, "None, as long as the training lasts")
        if self.choice not in (known := get_args(Choice)):
            raise ValueError(f"choice must be one of {', '.join(known)}, got {self.choice!r}; 'useful' is no control.")
        number = self.random_subgoals
        if number is not None and (self.choice == "useful" or not 1 <= number <= self.max_subgoals):
            raise ValueError(
                f"random_subgoals must be None, or with choice=random_events or random_changes lie in "
                f"[1, {self.max_subgoals}] (max_subgoals), got {number} with choice={self.choice}."
            )

    def make(self, observation: TensorSpec, num_actions: int) -> tuple[EventCritic, Selection]:
        """What tells events apart, and what chooses those that are subgoals.

        Args:
            observation: spec of the observation ``[N, ...]``.
            num_actions: of the environment.

        Returns:
            The critic, and the selection that reads its events.

        Raises:
            ValueError: if ``choice`` is ``"random_changes"`` and the observation has no cells of codes.
        """
        table = SubgoalTable(self.max_subgoals, max_tokens=max(256, self.max_subgoals))
        number = self.random_subgoals or self.max_subgoals
        if self.choice == "random_changes":
            dims, sizes = len(observation.shape) - 1, sizes_of(observation)
            changes = RandomChanges(sizes, number=number, num_dims=dims, warmup_frames=self.warmup_frames)
            return EventCritic(changes, table), RandomSelection(number, number=number)
        detector = make_change_detector(observation, num_actions, warmup_frames=self.warmup_frames)
        if self.choice == "random_events":
            return EventCritic(detector, table), RandomSelection(detector.num_tokens, number=number)
        return EventCritic(detector, table), EventSelection(detector, max_subgoals=self.max_subgoals)
