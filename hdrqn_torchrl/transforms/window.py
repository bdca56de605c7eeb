"""A window around the agent, cut out of the screen."""

from __future__ import annotations

from functools import cache
from itertools import accumulate

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.nn.functional import interpolate
from torchrl.data import Bounded, Composite
from torchrl.envs.transforms import Transform

from hdrqn_torchrl import keys
from hdrqn_torchrl.devices import on_host


class Window(Transform):
    """Cuts a square window around the agent out of the screen and resizes it (section IV-D: 70x70 to 44x44 pixels).

    TorchRL's ``CenterCrop`` and ``Resize`` can't follow the agent, hence this transform.

    Args:
        view: side of the window in pixels, black beyond the edges of the screen; ``None``: the whole screen.
        size: side of the resulting image in pixels.
        keep_pixels: whether to keep the entry with the screen.
        pixels_key: screen ``[*batch, height, width, C]`` uint8.
        position_key: the agent's centre, x and y in pixels ``[*batch, 2]``; not read for the whole screen.
        out_key: resulting image ``[*batch, C, size, size]`` uint8.

    Raises:
        ValueError: if ``view`` or ``size`` is not positive.

    Examples:
        >>> from tensordict import TensorDict
        >>> pixels, position = torch.full((210, 160, 3), 9, dtype=torch.uint8), torch.tensor([0.0, 90.0])
        >>> step = TensorDict({"pixels": pixels, "position": position})
        >>> image = Window(view=70, size=2).forward(step)["observation"]
        >>> image[0].tolist()  # beyond the left edge it is black
        [[1, 8], [1, 8]]
    """

    def __init__(
        self,
        view: int | None = 70,
        size: int = 44,
        *,
        keep_pixels: bool = False,
        pixels_key: NestedKey = keys.PIXELS,
        position_key: NestedKey = keys.POSITION,
        out_key: NestedKey = keys.OBSERVATION,
    ) -> None:
        if view is not None and view < 1:
            raise ValueError(f"view must be >= 1 or None, got {view}; use 70 as in the paper, or None for all.")
        if size < 1:
            raise ValueError(f"size must be >= 1, got {size}; use 44 as in the paper.")
        super().__init__(in_keys=[pixels_key, position_key], out_keys=[out_key])
        self.view, self.size, self.keep_pixels = view, size, keep_pixels
        self.pixels_key, self.position_key, self.out_key = pixels_key, position_key, out_key

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        pixels = tensordict.get(self.pixels_key)
        if self.view is not None:
            pixels = cut_out(pixels, tensordict.get(self.position_key), self.view)
        tensordict.set(self.out_key, resized(pixels, self.size))
        return tensordict if self.keep_pixels else tensordict.exclude(self.pixels_key, inplace=True)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        screen = observation_spec[self.pixels_key]
        shape = (*screen.shape[:-3], screen.shape[-1], self.size, self.size)
        observation_spec[self.out_key] = Bounded(0, 255, shape=shape, dtype=torch.uint8, device=screen.device)
        if not self.keep_pixels:
            del observation_spec[self.pixels_key]
        return observation_spec


def cut_out(pixels: Tensor, position: Tensor, view: int) -> Tensor:
    """Windows around given positions on screens, black beyond the edges.

    Args:
        pixels: screens ``[*, height, width, C]``.
        position: x and y of the centres ``[*, 2]``.
        view: side of the window.

    Returns:
        Windows ``[*, view, view, C]``.
    """
    height, width, channels = pixels.shape[-3:]
    flat = pixels.reshape(-1, height, width, channels)
    first = (position.reshape(-1, 2) - view / 2).round().long()  # [N, 2]
    reach = torch.arange(view, device=pixels.device)
    columns, rows = first[:, :1] + reach, first[:, 1:] + reach  # [N, view]
    row_seen, column_seen = (rows >= 0) & (rows < height), (columns >= 0) & (columns < width)
    number = torch.arange(len(flat), device=pixels.device)[:, None, None]
    windows = flat[number, rows.clamp(0, height - 1)[:, :, None], columns.clamp(0, width - 1)[:, None, :]]
    seen = row_seen[:, :, None] & column_seen[:, None, :]
    return windows.mul_(seen.unsqueeze(-1)).view(*pixels.shape[:-3], view, view, channels)


def resized(pixels: Tensor, size: int) -> Tensor:
    """Resizes screens ``[*, height, width, C]`` to images ``[*, C, size, size]``, bilinear with antialiasing.

    The result is the same on every device.
    """
    batch = pixels.shape[:-3]
    images = pixels.reshape(-1, *pixels.shape[-3:]).permute(0, 3, 1, 2)
    if on_host(images):
        small = interpolate(images, (size, size), mode="bilinear", antialias=True, align_corners=False)
    else:
        small = interpolated(images, size)
    return small.contiguous().view(*batch, *small.shape[1:])


def interpolated(images: Tensor, size: int) -> Tensor:
    """The exact result of ``interpolate`` for uint8 images on a CPU, on any device.

    PyTorch has a kernel for uint8 images on CPUs only. It takes a weighted mean of the columns, then of the rows, as
    Pillow does, with weights that are multiples of a power of two, and rounds the result. These sums are exact in
    float64.

    Args:
        images: ``[N, C, height, width]`` uint8.
        size: side of the result.

    Returns:
        ``[N, C, size, size]`` uint8.
    """
    across = _along_rows(images.double(), size)
    return _along_rows(across.mT, size).mT.to(torch.uint8)


def _along_rows(images: Tensor, size: int) -> Tensor:
    """``[*, height, width]`` -> ``[*, height, size]``; integers held as float64."""
    if images.shape[-1] == size:
        return images
    weights, unit = _weights(images.shape[-1], size, images.device)
    return ((images @ weights + unit / 2) / unit).floor().clamp(0, 255)


@cache
def _weights(length: int, size: int, device: torch.device) -> tuple[Tensor, int]:
    """Integer weights of ``length`` pixels in each of ``size`` pixels, ``[length, size]`` float64, and their unit.

    The weights of a pixel form a triangle around its centre, as wide as two pixels of the coarser grid. The unit (what
    stands for 1) is the largest power of two for which the weights fit into 16 bits.
    """
    scale = length / size
    reach = max(scale, 1.0)
    weights = torch.zeros(length, size, dtype=torch.float64)
    for pixel in range(size):
        centre = scale * (pixel + 0.5)
        touched = range(max(int(centre - reach + 0.5), 0), min(int(centre + reach + 0.5), length))
        triangle = [max(0.0, 1.0 - abs((place - centre + 0.5) * (1.0 / reach))) for place in touched]
        *_, total = accumulate(triangle)  # sums in this order, like the CPU's kernel; sum() would be more exact
        weights[touched.start : touched.stop, pixel] = torch.tensor(triangle, dtype=torch.float64) / total
    largest, unit = weights.max().item(), 1
    while unit < 2**22 and int(0.5 + largest * 2 * unit) < 2**15:
        unit *= 2
    return (weights * unit + 0.5).floor().to(device), unit
