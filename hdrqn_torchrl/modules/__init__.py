"""Networks, controllers and exploration as (TensorDict) modules."""

from hdrqn_torchrl.modules.all_subgoals import AllSubgoalsPolicy
from hdrqn_torchrl.modules.all_subgoals_network import AllSubgoalsNetwork
from hdrqn_torchrl.modules.architectures import Architecture, compact_network, observation_predictor, paper_network
from hdrqn_torchrl.modules.code_features import CodeFeatures
from hdrqn_torchrl.modules.decoders import CellDecoder, CodeDecoder, Decoder, ImageDecoder, VectorDecoder
from hdrqn_torchrl.modules.exploration import EpsilonGreedy
from hdrqn_torchrl.modules.features import CellFeatures, CellsToImage, ConvFeatures, Features, FullyConnectedFeatures
from hdrqn_torchrl.modules.hierarchical_policy import HierarchicalPolicy
from hdrqn_torchrl.modules.meta_controller import MetaController
from hdrqn_torchrl.modules.prediction import ObservationPredictor
from hdrqn_torchrl.modules.q_network import DuelingHead, QNetwork
from hdrqn_torchrl.modules.repeating import RepeatingEpsilonGreedy
from hdrqn_torchrl.modules.sub_controller import SubController
from hdrqn_torchrl.modules.success import SubgoalSuccess, SuccessEpsilonGreedy
from hdrqn_torchrl.modules.watching import writing_values

__all__ = [
    "AllSubgoalsNetwork",
    "AllSubgoalsPolicy",
    "Architecture",
    "CellDecoder",
    "CellFeatures",
    "CellsToImage",
    "CodeDecoder",
    "CodeFeatures",
    "ConvFeatures",
    "Decoder",
    "DuelingHead",
    "EpsilonGreedy",
    "Features",
    "FullyConnectedFeatures",
    "HierarchicalPolicy",
    "ImageDecoder",
    "MetaController",
    "ObservationPredictor",
    "QNetwork",
    "RepeatingEpsilonGreedy",
    "SubController",
    "SubgoalSuccess",
    "SuccessEpsilonGreedy",
    "VectorDecoder",
    "compact_network",
    "observation_predictor",
    "paper_network",
    "writing_values",
]
