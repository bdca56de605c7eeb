"""The two families of networks; every algorithm can be built from either."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import nn
from torchrl.data import TensorSpec

from hdrqn_torchrl.envs.observations import ProblemOf, code_sizes, observation_kind, observation_problem
from hdrqn_torchrl.modules.code_features import CodeFeatures
from hdrqn_torchrl.modules.decoders import CellDecoder, CodeDecoder, Decoder, ImageDecoder, VectorDecoder
from hdrqn_torchrl.modules.features import (
    CellFeatures,
    CellsToImage,
    ChainedFeatures,
    ConvFeatures,
    Features,
    FullyConnectedFeatures,
)
from hdrqn_torchrl.modules.prediction import ObservationPredictor
from hdrqn_torchrl.modules.q_network import QNetwork
from hdrqn_torchrl.modules.scaled_vector import ScaledVector
from hdrqn_torchrl.modules.sizes import check_memory_span, check_size, check_widths

_COARSE = 14  # side of predicted images in pixels


@dataclass(frozen=True, kw_only=True)
class Architecture:
    """How to build a Q-network.

    Args:
        hidden_size: H, size of the recurrent layer.
        observation_features: makes the feature extractor for an observation spec ``[N, ...]``.
        vector_features: makes the feature extractor for a vector of a given size (v2's meta-controller).
        gate_features: whether the subgoal also scales the features, besides being appended to them.
        memory_span: the steps that a new LSTM keeps things for; 0: as PyTorch makes it, which forgets half in a step.
        observation_problem: takes an observation's spec and its shape without the batch dimensions; returns what an
            observation must be and what to do about it, or ``None`` if this one can be read.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> architecture = Architecture(
        ...     hidden_size=8,
        ...     observation_features=lambda spec: CellFeatures(spec.shape[-1], spec.n, (16,)),
        ...     vector_features=lambda size: FullyConnectedFeatures(size, (16,)),
        ... )
        >>> env = MultiGoalGridEnv(num_envs=2)
        >>> network = architecture.q_network(env.observation_spec["observation"], num_actions=4)
        >>> value, state = network.step(env.reset()["observation"], None, network.initial_state(2))
        >>> value.shape
        torch.Size([2, 4])
    """

    hidden_size: int
    gate_features: bool = False
    memory_span: int = 0
    observation_features: Callable[[TensorSpec], Features]
    vector_features: Callable[[int], Features]
    observation_problem: ProblemOf = lambda spec, shape: None

    def __post_init__(self) -> None:
        check_size("hidden_size", self.hidden_size, "64, or the paper's 256")
        check_memory_span(self.memory_span)

    def features(self, inputs: TensorSpec | int) -> Features:
        """The feature extractor for an observation spec or a vector of a given size, tried once.

        Raises:
            ValueError: if it is no module with ``out_features``, or returns another number of features.
        """
        name = "vector_features" if isinstance(inputs, int) else "observation_features"
        made = self.vector_features(inputs) if isinstance(inputs, int) else self.observation_features(inputs)
        if not (isinstance(made, nn.Module) and isinstance(getattr(made, "out_features", None), int)):
            raise ValueError(f"{name} must make a module with the attribute out_features, got {made!r}; see Features.")
        example = torch.zeros(1, inputs) if isinstance(inputs, int) else inputs.zero()[:1].cpu()
        training = made.training
        with torch.no_grad():
            found = list(made.eval()(example).shape)
        if found != [1, made.out_features]:
            raise ValueError(
                f"{name} must make a module that returns [*, out_features={made.out_features}], got {found} for an "
                f"input {list(example.shape)}; set out_features to what it returns, and flatten the rest."
            )
        return made.train(training)

    def q_network(
        self,
        inputs: TensorSpec | int,
        *,
        num_actions: int,
        num_conditions: int = 0,
        recurrent: bool = True,
        prediction_steps: int = 0,
    ) -> QNetwork:
        """A Q-network for an observation spec or a vector of a given size.

        With ``prediction_steps`` its memory also learns to predict observations up to that many steps ahead.
        """
        check_size("prediction_steps", prediction_steps, "4, or 0 for no prediction", least=0)
        predictor = None
        if prediction_steps and not isinstance(inputs, int):
            predictor = observation_predictor(inputs, self.hidden_size, num_actions, prediction_steps)
        return QNetwork(
            self.features(inputs),
            num_actions=num_actions,
            hidden_size=self.hidden_size,
            num_conditions=num_conditions,
            gate_features=self.gate_features,
            recurrent=recurrent,
            memory_span=self.memory_span,
            predictor=predictor,
        )


def paper_network(hidden_size: int = 256, *, gate_features: bool = False, memory_span: int = 0) -> Architecture:
    """The paper's networks: 44x44x3 image, 4 conv + ReLU (or 4 dense + ReLU on a vector) -> 256 -> LSTM -> dueling.

    Cell codes are drawn as an image inside the network; other codes are read as a vector.

    Args:
        hidden_size: H, size of the LSTM.
        gate_features: whether the subgoal also scales the features, besides being appended to them.
        memory_span: as in :class:`Architecture`.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> spec = MultiGoalGridEnv(num_envs=2).observation_spec["observation"]
        >>> network = paper_network().q_network(spec, num_actions=4)
        >>> network.unroll(spec.zero((3,)), None).shape
        torch.Size([3, 2, 4])
    """

    dense = (256, 256, 256, 256)

    def observation_features(spec: TensorSpec) -> Features:
        if observation_kind(spec, spec.shape[1:]) == "cells":
            return ChainedFeatures(CellsToImage(spec.shape[-1], spec.n), ConvFeatures())
        return _features(spec, dense, channels=(32, 64, 64, 64))

    return Architecture(
        hidden_size=hidden_size,
        gate_features=gate_features,
        memory_span=memory_span,
        observation_features=observation_features,
        vector_features=lambda size: FullyConnectedFeatures(size, dense),
        observation_problem=observation_problem,
    )


def compact_network(
    hidden_size: int = 64, widths: Sequence[int] = (128,), *, gate_features: bool = True, memory_span: int = 0
) -> Architecture:
    """Small networks on the same information: one-hot codes (or a narrow stack of convolutions) -> LSTM -> dueling.

    Args:
        hidden_size: H, size of the LSTM.
        widths: sizes of the dense layers, at least one.
        gate_features: whether the subgoal also scales the features, besides being appended to them.
        memory_span: as in :class:`Architecture`.

    Raises:
        ValueError: if a size is not positive.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> spec = MultiGoalGridEnv(num_envs=2).observation_spec["observation"]
        >>> network = compact_network(16, (32,)).q_network(spec, num_actions=4, num_conditions=2)
        >>> value, (hidden, cell) = network.step(spec.zero(), torch.tensor([0, 1]), network.initial_state(2))
        >>> value.shape, hidden.shape
        (torch.Size([2, 4]), torch.Size([2, 16]))
    """
    sizes = check_widths(widths)

    def observation_features(spec: TensorSpec) -> Features:
        return _features(spec, sizes, channels=(16, 32, 32, 32))

    return Architecture(
        hidden_size=hidden_size,
        gate_features=gate_features,
        memory_span=memory_span,
        observation_features=observation_features,
        vector_features=lambda size: FullyConnectedFeatures(size, sizes),
        observation_problem=observation_problem,
    )


def _features(spec: TensorSpec, widths: tuple[int, ...], *, channels: tuple[int, int, int, int]) -> Features:
    """The feature extractor for an observation ``[N, ...]``; ``channels`` are those of convolutions."""
    shape = spec.shape[1:]
    kind = observation_kind(spec, shape)
    if kind == "cells":
        return CellFeatures(shape[-1], spec.n, widths)
    if kind == "codes":
        return CodeFeatures(code_sizes(spec, shape), widths, num_dims=len(shape))
    if kind == "image":
        return ConvFeatures(shape[0], _sides(shape), widths[-1], channels)
    return ChainedFeatures(ScaledVector(spec), FullyConnectedFeatures(shape[-1], widths))


def observation_predictor(
    spec: TensorSpec, hidden_size: int, num_actions: int, max_steps: int, width: int = 128
) -> ObservationPredictor:
    """A predictor for an observation spec ``[N, ...]``: of codes, of a coarse image, or of a vector.

    Raises:
        ValueError: if the built-in networks can't read the observation, either.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> spec = MultiGoalGridEnv(num_envs=2).observation_spec["observation"]
        >>> predictor = observation_predictor(spec, hidden_size=8, num_actions=4, max_steps=3)
        >>> memory, action = torch.zeros(2, 7, 8), torch.zeros(2, 7, dtype=torch.int64)
        >>> predictor(memory, action, torch.zeros(2, 7, *spec.shape[1:], dtype=spec.dtype), steps=3).shape
        torch.Size([2, 4])
    """
    shape = spec.shape[1:]
    kind = observation_kind(spec, shape)
    if kind is None:
        raise ValueError(
            f"prediction_steps must be 0 if the observation is none that built-in networks read, got {max_steps} for "
            f"{list(spec.shape)}; there is no decoder for it."
        )

    def decoder(in_features: int) -> Decoder:
        if kind == "cells":
            return CellDecoder(in_features, shape[-1], spec.n)
        if kind == "codes":
            return CodeDecoder(in_features, code_sizes(spec, shape), num_dims=len(shape))
        if kind == "image":
            height, width = _sides(shape)
            return ImageDecoder(in_features, shape[0], (min(height, _COARSE), min(width, _COARSE)))
        return VectorDecoder(in_features, shape[-1], ScaledVector(spec))

    return ObservationPredictor(
        decoder, hidden_size=hidden_size, num_actions=num_actions, max_steps=max_steps, width=width
    )


def _sides(shape: Sequence[int]) -> tuple[int, int]:
    return shape[-2], shape[-1]
