"""Learning: one learner for each level, its settings, and what watches over it."""

from hdrqn_torchrl.learning.learner import Extract, Learner
from hdrqn_torchrl.learning.phases import PhaseOne, Phases
from hdrqn_torchrl.learning.settings import LearnerSettings

__all__ = ["Extract", "Learner", "LearnerSettings", "PhaseOne", "Phases"]
