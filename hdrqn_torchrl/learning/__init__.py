"""Learning: one learner for each level, its settings, and its monitors."""

from hdrqn_torchrl.learning.learner import Learner
from hdrqn_torchrl.learning.legs import LegCounter
from hdrqn_torchrl.learning.monitors import Monitor, VisitCounter
from hdrqn_torchrl.learning.phases import PhaseOne, Phases, phase_monitors
from hdrqn_torchrl.learning.random_symmetry import RandomSymmetry
from hdrqn_torchrl.learning.replay import Extract, Replay
from hdrqn_torchrl.learning.settings import LearnerSettings

__all__ = [
    "Extract",
    "Learner",
    "LearnerSettings",
    "LegCounter",
    "Monitor",
    "PhaseOne",
    "Phases",
    "RandomSymmetry",
    "Replay",
    "VisitCounter",
    "phase_monitors",
]
