"""The two families of networks; every algorithm can be built from either."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import nn
from torchrl.data import Bounded, Categorical, OneHot, TensorSpec

from hdrqn_torchrl.modules.features import (
    SMALLEST_IMAGE,
    CellFeatures,
    CellsToImage,
    ChainedFeatures,
    ConvFeatures,
    Features,
    FullyConnectedFeatures,
)
from hdrqn_torchrl.modules.prediction import CellDecoder, Decoder, ImageDecoder, ObservationPredictor
from hdrqn_torchrl.modules.q_network import QNetwork
from hdrqn_torchrl.modules.sizes import check_size, check_widths

_LARGEST_FLOAT = 10.0  # images in float32 with bounds above this are not taken to be scaled to about 1


@dataclass(frozen=True, kw_only=True)
class Architecture:
    """How to build a Q-network.

    Args:
        hidden_size: H, size of the recurrent layer.
        observation_features: makes the feature extractor for an observation spec.
        vector_features: makes the feature extractor for a vector of a given size (v2's meta-controller).
        gate_features: whether the subgoal also scales the features, besides being appended to them.
        observation_problem: takes an observation's spec and its shape without the batch dimensions; returns what an
            observation must be and what to do about it, or ``None`` if this one can be read.
    """

    hidden_size: int
    gate_features: bool = False
    observation_features: Callable[[TensorSpec], Features]
    vector_features: Callable[[int], Features]
    observation_problem: Callable[[TensorSpec, Sequence[int]], tuple[str, str] | None] = lambda spec, shape: None

    def __post_init__(self) -> None:
        check_size("hidden_size", self.hidden_size, "64, or the paper's 256")

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
            predictor=predictor,
        )


def paper_network(hidden_size: int = 256, *, gate_features: bool = False) -> Architecture:
    """The paper's networks: 44x44x3 image, 4 conv + ReLU (or 4 dense + ReLU on a vector) -> 256 -> LSTM -> dueling.

    Cell codes are drawn as an image inside the network.

    Args:
        hidden_size: H, size of the LSTM.
        gate_features: whether the subgoal also scales the features, besides being appended to them.
    """

    def observation_features(spec: TensorSpec) -> Features:
        if not is_grid(spec):
            return ConvFeatures(spec.shape[-3], spec.shape[-1])
        return ChainedFeatures(CellsToImage(spec.shape[-1], spec.n), ConvFeatures())

    return Architecture(
        hidden_size=hidden_size,
        gate_features=gate_features,
        observation_features=observation_features,
        vector_features=lambda size: FullyConnectedFeatures(size, (256, 256, 256, 256)),
        observation_problem=grid_or_image,
    )


def compact_network(
    hidden_size: int = 64, widths: Sequence[int] = (128,), *, gate_features: bool = True
) -> Architecture:
    """Small networks on the same information: one-hot cells (or a narrow stack of convolutions) -> LSTM -> dueling.

    Args:
        hidden_size: H, size of the LSTM.
        widths: sizes of the dense layers, at least one.
        gate_features: whether the subgoal also scales the features, besides being appended to them.

    Raises:
        ValueError: if a size is not positive.
    """
    sizes = check_widths(widths)

    def observation_features(spec: TensorSpec) -> Features:
        if is_grid(spec):
            return CellFeatures(spec.shape[-1], spec.n, sizes)
        return ConvFeatures(spec.shape[-3], spec.shape[-1], sizes[-1], channels=(16, 32, 32, 32))

    return Architecture(
        hidden_size=hidden_size,
        gate_features=gate_features,
        observation_features=observation_features,
        vector_features=lambda size: FullyConnectedFeatures(size, sizes),
        observation_problem=grid_or_image,
    )


def grid_or_image(spec: TensorSpec, shape: Sequence[int]) -> tuple[str, str] | None:
    """Checks that :func:`paper_network` and :func:`compact_network` can read an observation.

    Args:
        spec: spec of the observation.
        shape: shape of the observation without the batch dimensions.

    Returns:
        What the observation must be and what to do about it; ``None`` if it can be read.
    """
    square = len(shape) >= 2 and shape[-1] == shape[-2]
    if type(spec) is Categorical and not spec.dtype.is_floating_point and len(shape) == 2 and square:
        return None
    image = spec.dtype in (torch.uint8, torch.float32) and not isinstance(spec, Categorical | OneHot)
    if isinstance(spec, Bounded) and spec.dtype == torch.float32:
        image = bool(spec.space.high.max() <= _LARGEST_FLOAT)
    if image and len(shape) == 3 and square and shape[-1] >= SMALLEST_IMAGE:
        return None
    return (
        "a square of cell codes [V, V] (Categorical, integers) or a square image [channels, S, S] with "
        f"S >= {SMALLEST_IMAGE} pixels, uint8 or float32 of about 1",
        "use a Categorical spec for cell codes, ToTensorImage and Resize for images, and for anything else an "
        "Architecture with your own observation_features",
    )


def is_grid(spec: TensorSpec) -> bool:
    """Whether an observation spec is a window of cell codes (otherwise it is an image)."""
    return isinstance(spec, Categorical)


def observation_predictor(
    spec: TensorSpec, hidden_size: int, num_actions: int, max_steps: int, width: int = 128
) -> ObservationPredictor:
    """A predictor for an observation spec ``[N, ...]``: of cell codes, or of a coarse image.

    Raises:
        ValueError: if the observation is neither cell codes nor an image.
    """
    if spec.ndim != (3 if is_grid(spec) else 4):
        raise ValueError(
            f"prediction_steps must be 0 if the observation is neither cell codes [V, V] nor an image, got "
            f"{max_steps} for {list(spec.shape)}; there is no decoder for it."
        )

    def decoder(in_features: int) -> Decoder:
        if is_grid(spec):
            return CellDecoder(in_features, spec.shape[-1], spec.n)
        return ImageDecoder(in_features, spec.shape[-3])

    return ObservationPredictor(
        decoder, hidden_size=hidden_size, num_actions=num_actions, max_steps=max_steps, width=width
    )
