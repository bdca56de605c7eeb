"""Feature extractors, the layers between an observation and the recurrent layer.

Each maps ``[*, ...]`` to ``[*, out_features]`` for any number of leading dimensions, so that the same module handles
single steps and whole sequences.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from hdrqn_torchrl.devices import autocast_dtype
from hdrqn_torchrl.envs.grid.cells import nearest_cell, palette
from hdrqn_torchrl.modules.sizes import check_sides, check_size, check_widths

_USUAL_VIEW = 5
_KERNELS_AND_STRIDES = ((5, 2), (3, 2), (3, 2), (3, 1))


class Features(nn.Module):
    """Base class of feature extractors; ``out_features`` is the number of features."""

    out_features: int


class CellsToImage(nn.Module):
    """Draws cell codes as a colour image inside the network, so that replay stores 25 bytes per view, not 5,808.

    Args:
        view: side of the window in cells.
        num_codes: number of cell codes.
        size: side of the image in pixels.

    Shapes:
        ``[*, view, view]`` uint8 -> ``[*, 3, size, size]`` float in [0, 1].

    Examples:
        >>> CellsToImage(view=5, num_codes=5)(torch.zeros(2, 5, 5, dtype=torch.uint8)).shape
        torch.Size([2, 3, 44, 44])
    """

    _cells: Tensor
    _colours: Tensor

    def __init__(self, view: int, num_codes: int, size: int = 44) -> None:
        super().__init__()
        _check_grid(view, num_codes)
        check_size("size", size, 44)
        self.register_buffer("_cells", nearest_cell(size, view), persistent=False)  # for each row and each column
        self.register_buffer("_colours", palette(num_codes).float() / 255, persistent=False)

    def forward(self, cells: Tensor) -> Tensor:
        colours = self._colours.to(autocast_dtype(self._colours))
        small = functional.embedding(cells.int(), colours)  # [*, view, view, 3]
        return small.index_select(-2, self._cells).index_select(-3, self._cells).movedim(-1, -3)


class ConvFeatures(Features):
    """Four convolutions with ReLU, then one dense layer with ReLU: the paper's image features.

    Kernels have sides of 5, 3, 3 and 3 pixels and strides of 2, 2, 2 and 1. Along a side of fewer than 33 pixels, a
    stride is 1 where what 2 would leave is too short for the later kernels, and a kernel is as long as what is left if
    that is shorter.

    Args:
        in_channels: channels of the image.
        size: side of the image in pixels, or its height and width.
        out_features: number of features.
        channels: output channels of the four convolutions.

    Shapes:
        ``[*, in_channels, height, width]`` uint8 in [0, 255] or float in [0, 1] -> ``[*, out_features]``.

    Examples:
        >>> ConvFeatures()(torch.zeros(2, 8, 3, 44, 44)).shape
        torch.Size([2, 8, 256])
        >>> ConvFeatures(in_channels=4, size=(10, 7))(torch.zeros(2, 4, 10, 7)).shape
        torch.Size([2, 256])
    """

    def __init__(
        self,
        in_channels: int = 3,
        size: int | tuple[int, int] = 44,
        out_features: int = 256,
        channels: tuple[int, int, int, int] = (32, 64, 64, 64),
    ) -> None:
        super().__init__()
        check_size("in_channels", in_channels, "3 for colour images, 1 for grey images")
        height, width = check_sides(size, "44, as in the paper")
        check_size("out_features", out_features, 256)
        check_widths(channels, "channels")
        if len(channels) != 4:
            raise ValueError(f"channels must be four sizes, got {len(channels)}; the paper uses (32, 64, 64, 64).")
        (along, height), (across, width) = _fitted(height), _fitted(width)
        layers: list[nn.Module] = []
        previous = in_channels
        for number, down, right in zip(channels, along, across, strict=True):
            kernel, stride = zip(down, right, strict=True)
            layers += [nn.Conv2d(previous, number, kernel, stride), nn.ReLU(inplace=True)]
            previous = number
        self.convolutions = nn.Sequential(*layers).to(memory_format=torch.channels_last)  # fast in oneDNN and cuDNN
        self.dense = nn.Sequential(
            nn.Flatten(), nn.Linear(previous * height * width, out_features), nn.ReLU(inplace=True)
        )
        self.out_features = out_features

    def forward(self, image: Tensor) -> Tensor:
        images = image.reshape(-1, *image.shape[-3:])
        first, others = self.convolutions[0], self.convolutions[1:]
        assert isinstance(first, nn.Conv2d)
        weight = first.weight
        if images.dtype == torch.uint8:  # exact even in bfloat16; scaling the weights costs less
            images, weight = images.to(autocast_dtype(images) or weight.dtype), weight / 255
        images = images.contiguous(memory_format=torch.channels_last)  # of bytes that takes twice the time
        features = self.dense(others(functional.conv2d(images, weight, first.bias, first.stride)))
        return features.view(*image.shape[:-3], self.out_features)


class CellFeatures(Features):
    """Cell codes as one-hot vectors through small dense layers: the same information as the image, at less cost.

    Each unit has a weight for every cell of the window, and Adam changes all of them by about the learning rate at
    once, so a larger window means a larger step. For windows of more than 5x5 cells the inputs are therefore scaled
    down, and the initial weights of the first layer up by the same factor: a learning rate then works alike for every
    view.

    Args:
        view: side of the window in cells.
        num_codes: number of cell codes.
        widths: sizes of the dense layers.

    Shapes:
        ``[*, view, view]`` uint8 -> ``[*, widths[-1]]``.

    Examples:
        >>> CellFeatures(view=5, num_codes=5)(torch.zeros(2, 5, 5, dtype=torch.uint8)).shape
        torch.Size([2, 128])
    """

    _one_hot: Tensor

    def __init__(self, view: int, num_codes: int, widths: tuple[int, ...] = (128,)) -> None:
        super().__init__()
        _check_grid(view, num_codes)
        scale = min(1.0, (_USUAL_VIEW / view) ** 2)
        self.register_buffer("_one_hot", torch.eye(num_codes) * scale, persistent=False)
        self.dense = dense_layers(view * view * num_codes, widths)
        with torch.no_grad():
            next(self.dense.parameters()).div_(scale)
        self.out_features = widths[-1]

    def forward(self, cells: Tensor) -> Tensor:
        one_hot = self._one_hot.to(autocast_dtype(self._one_hot))
        return on_rows(self.dense, functional.embedding(cells.flatten(-2).int(), one_hot).flatten(-2))


class FullyConnectedFeatures(Features):
    """Dense layers with ReLU on a vector; v2's meta-controller reads the sub-controller's hidden state through them.

    Args:
        in_features: size of the vector.
        widths: sizes of the dense layers; the paper uses four of 256.

    Shapes:
        ``[*, in_features]`` of any dtype (floats, integers, bool) -> ``[*, widths[-1]]``.

    Examples:
        >>> features = FullyConnectedFeatures(6, (32, 16))
        >>> features(torch.zeros(3, 5, 6)).shape, features.out_features
        (torch.Size([3, 5, 16]), 16)
    """

    def __init__(self, in_features: int, widths: tuple[int, ...] = (256, 256, 256, 256)) -> None:
        super().__init__()
        check_size("in_features", in_features, "the size of the vector")
        self.dense = dense_layers(in_features, widths)
        self.out_features = widths[-1]

    def forward(self, vector: Tensor) -> Tensor:
        if not vector.is_floating_point():
            vector = vector.to(next(self.dense.parameters()).dtype)
        return on_rows(self.dense, vector)


class ChainedFeatures(Features):
    """A module in front of a feature extractor, such as :class:`CellsToImage` in front of :class:`ConvFeatures`."""

    def __init__(self, first: nn.Module, features: Features) -> None:
        super().__init__()
        self.first, self.features, self.out_features = first, features, features.out_features

    def forward(self, observation: Tensor) -> Tensor:
        return self.features(self.first(observation))


def _fitted(side: int) -> tuple[list[tuple[int, int]], int]:
    """Kernels and strides of the four convolutions along a side, and what they leave of it."""
    fitted = []
    for index, (kernel, stride) in enumerate(_KERNELS_AND_STRIDES):
        kernel = min(kernel, side)
        needed = 1 + sum(later - 1 for later, _ in _KERNELS_AND_STRIDES[index + 1 :])
        if (side - kernel) // stride + 1 < needed:
            stride = 1
        fitted.append((kernel, stride))
        side = (side - kernel) // stride + 1
    return fitted, side


def _check_grid(view: int, num_codes: int) -> None:
    check_size("view", view, 5)
    check_size("num_codes", num_codes, "the number of different cells")


def dense_layers(in_features: int, widths: tuple[int, ...]) -> nn.Sequential:
    """Dense layers of these sizes, each with ReLU."""
    layers: list[nn.Module] = []
    for width in check_widths(widths):
        layers += [nn.Linear(in_features, width), nn.ReLU(inplace=True)]
        in_features = width
    return nn.Sequential(*layers)


def on_rows(layers: nn.Sequential, vectors: Tensor) -> Tensor:
    """Applies layers to ``[*, I]`` as rows, because autograd copies a lot when ReLU writes into a view."""
    rows = layers(vectors.reshape(-1, vectors.shape[-1]))
    return rows.view(*vectors.shape[:-1], rows.shape[-1])
