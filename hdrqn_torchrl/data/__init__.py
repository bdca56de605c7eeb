"""From collected steps to replayed sequences."""

from hdrqn_torchrl.data.continuity import Continuity
from hdrqn_torchrl.data.hindsight import HindsightOptions, relabel_subgoals
from hdrqn_torchrl.data.history import OptionHistory, refresh_hidden
from hdrqn_torchrl.data.lengths import LongerEpisodes
from hdrqn_torchrl.data.options import OptionExtractor, episode_of
from hdrqn_torchrl.data.prioritized import PrioritizedSequenceSampler
from hdrqn_torchrl.data.replay import FROM_STARTS, Sampling, SequenceBuffer, make_sequence_buffer, sample_sequences
from hdrqn_torchrl.data.samplers import EpisodeSliceSampler, EpisodeStartSampler, StepSliceSampler, WholeEpisodeSampler
from hdrqn_torchrl.data.steps import StepSelector

__all__ = [
    "FROM_STARTS",
    "Continuity",
    "EpisodeSliceSampler",
    "EpisodeStartSampler",
    "HindsightOptions",
    "LongerEpisodes",
    "OptionExtractor",
    "OptionHistory",
    "PrioritizedSequenceSampler",
    "Sampling",
    "SequenceBuffer",
    "StepSelector",
    "StepSliceSampler",
    "WholeEpisodeSampler",
    "episode_of",
    "make_sequence_buffer",
    "refresh_hidden",
    "relabel_subgoals",
    "sample_sequences",
]
