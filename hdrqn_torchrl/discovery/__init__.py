"""Subgoals that an agent finds itself, in the changes of what it sees that its movements do not explain."""

from hdrqn_torchrl.discovery.changes import ChangeDetector, make_change_detector
from hdrqn_torchrl.discovery.critic import DiscoveredSubgoals, EventCritic, discovered_set
from hdrqn_torchrl.discovery.events import EventSelection
from hdrqn_torchrl.discovery.monitor import Discovery
from hdrqn_torchrl.discovery.random_choice import RandomChanges, RandomSelection
from hdrqn_torchrl.discovery.relabelling import relabel
from hdrqn_torchrl.discovery.selection import Chosen, Selection
from hdrqn_torchrl.discovery.settings import DiscoverySettings
from hdrqn_torchrl.discovery.table import SubgoalTable

__all__ = [
    "ChangeDetector",
    "Chosen",
    "DiscoveredSubgoals",
    "Discovery",
    "DiscoverySettings",
    "EventCritic",
    "EventSelection",
    "RandomChanges",
    "RandomSelection",
    "Selection",
    "SubgoalTable",
    "discovered_set",
    "make_change_detector",
    "relabel",
]
