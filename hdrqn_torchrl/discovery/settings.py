"""How an agent finds its subgoals."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl.data import TensorSpec

from hdrqn_torchrl.discovery.changes import make_change_detector
from hdrqn_torchrl.discovery.critic import EventCritic
from hdrqn_torchrl.discovery.events import EventSelection
from hdrqn_torchrl.discovery.selection import Selection
from hdrqn_torchrl.discovery.table import SubgoalTable
from hdrqn_torchrl.modules.sizes import check_size


@dataclass(frozen=True, kw_only=True)
class DiscoverySettings:
    """When subgoals are looked for, and how many there may be.

    Args:
        max_subgoals: number of slots; a slot that is free costs a head and nothing else.
        warmup_frames: environment frames in which the agent learns how its movements change what it sees; what was
            stored meanwhile is forgotten, as its events are unknown.
        discovery_frames: frames between two looks for subgoals.
        until_frames: frames after which the set stays as it is.

    Raises:
        ValueError: if a value breaks its rule.
    """

    max_subgoals: int = 8
    warmup_frames: int = 10_000
    discovery_frames: int = 20_000
    until_frames: int = 400_000

    def __post_init__(self) -> None:
        for name, usual in (("max_subgoals", 8), ("warmup_frames", 10_000), ("discovery_frames", 20_000)):
            check_size(name, getattr(self, name), usual)
        check_size("until_frames", self.until_frames, 400_000)

    def make(self, observation: TensorSpec, num_actions: int) -> tuple[EventCritic, Selection]:
        """What tells events apart, and what chooses those that are subgoals.

        Args:
            observation: spec of the observation ``[N, ...]``.
            num_actions: of the environment.

        Returns:
            The critic, and the selection that reads its events.
        """
        detector = make_change_detector(observation, num_actions, warmup_frames=self.warmup_frames)
        selection = EventSelection(detector, max_subgoals=self.max_subgoals)
        return EventCritic(detector, SubgoalTable(self.max_subgoals)), selection
