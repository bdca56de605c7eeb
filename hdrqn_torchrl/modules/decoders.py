"""Predictions of observations from a vector, and their errors: one decoder for each kind of observation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from hdrqn_torchrl.modules.sizes import check_sides, check_size, check_widths


class Decoder(nn.Module):
    """Predicts an observation from a vector, and measures the error."""

    def error(self, vector: Tensor, observation: Tensor) -> Tensor:
        """Error ``[*]`` of the prediction from ``vector`` ``[*, D]``, given the true ``observation`` ``[*, ...]``."""
        raise NotImplementedError


class DecoderFactory(Protocol):
    """Makes a decoder for vectors of a given size."""

    def __call__(self, in_features: int) -> Decoder: ...


class CodeDecoder(Decoder):
    """Predicts each entry of a code vector; the error is the mean cross-entropy (nats per entry).

    Entries with the same number of codes are computed together, so that no logits are padding.

    Args:
        in_features: D.
        num_codes: number of codes of each entry, in the order of the flattened entries.
        num_dims: number of dimensions of the observation.

    Examples:
        >>> decoder = CodeDecoder(8, num_codes=(5, 3, 5))
        >>> decoder.error(torch.zeros(2, 3, 8), torch.zeros(2, 3, 3, dtype=torch.uint8)).shape
        torch.Size([2, 3])
    """

    _order: Tensor

    def __init__(self, in_features: int, num_codes: Sequence[int], *, num_dims: int = 1) -> None:
        super().__init__()
        check_size("in_features", in_features, 128)
        check_size("num_dims", num_dims, 1, least=0)
        sizes = check_widths(num_codes, "num_codes")
        order = sorted(range(len(sizes)), key=lambda entry: sizes[entry])
        self.num_dims = num_dims
        self.groups = [(sizes.count(size), size) for size in sorted(set(sizes))]  # numbers of entries and of codes
        self.logits = nn.Linear(in_features, sum(sizes))
        self.register_buffer("_order", torch.tensor(order), persistent=False)

    def error(self, vector: Tensor, observation: Tensor) -> Tensor:
        codes = observation.reshape(*vector.shape[:-1], -1)
        if len(self.groups) > 1:
            codes = codes.index_select(-1, self._order)
        logits = self.logits(vector).float().split([entries * size for entries, size in self.groups], -1)
        parts = codes.long().unsqueeze(-1).split([entries for entries, _ in self.groups], -2)
        errors = []
        for scores, chosen, group in zip(logits, parts, self.groups, strict=True):
            scores = scores.unflatten(-1, group)
            errors.append(scores.logsumexp(-1) - scores.gather(-1, chosen).squeeze(-1))
        return torch.cat(errors, -1).mean(-1)


class CellDecoder(CodeDecoder):
    """Predicts the code of every cell of a window; the error is the mean cross-entropy (nats per cell).

    Args:
        in_features: D.
        view: side of the window in cells.
        num_codes: number of cell codes.

    Examples:
        >>> decoder = CellDecoder(8, view=5, num_codes=5)
        >>> decoder.error(torch.zeros(2, 3, 8), torch.zeros(2, 3, 5, 5, dtype=torch.uint8)).shape
        torch.Size([2, 3])
    """

    def __init__(self, in_features: int, view: int, num_codes: int) -> None:
        check_size("view", view, 5)
        check_size("num_codes", num_codes, 5)
        super().__init__(in_features, (num_codes,) * view**2, num_dims=2)


class ImageDecoder(Decoder):
    """Predicts a coarse version of an image; the error is the mean squared error of intensities in [0, 1].

    Args:
        in_features: D.
        channels: number of channels of the image.
        size: side of the coarse image in pixels, or its height and width.

    Examples:
        >>> decoder = ImageDecoder(8, channels=3)
        >>> decoder.error(torch.zeros(2, 3, 8), torch.zeros(2, 3, 3, 44, 44, dtype=torch.uint8)).shape
        torch.Size([2, 3])
    """

    def __init__(self, in_features: int, channels: int, size: int | tuple[int, int] = 14) -> None:
        super().__init__()
        check_size("in_features", in_features, 128)
        check_size("channels", channels, 3)
        self.size = check_sides(size, 14)
        self.pixels = nn.Linear(in_features, channels * self.size[0] * self.size[1])

    def error(self, vector: Tensor, observation: Tensor) -> Tensor:
        images = observation.reshape(-1, *observation.shape[-3:]).float()
        coarse = averaged(images, self.size)
        if observation.dtype == torch.uint8:
            coarse /= 255
        guess = self.pixels(vector).float().flatten(0, -2)
        return (guess - coarse.flatten(1)).square().mean(-1).view(vector.shape[:-1])


def averaged(images: Tensor, size: tuple[int, int]) -> Tensor:
    """What ``adaptive_avg_pool2d`` computes, by two matrix products: a fifth of its time on a CPU.

    Args:
        images: ``[*, height, width]`` float32.
        size: height and width of the result.

    Examples:
        >>> averaged(torch.arange(8.0).view(2, 4), (1, 2))
        tensor([[2.5000, 4.5000]])
    """
    rows, columns = (_shares(side, parts, images.device) for side, parts in zip(images.shape[-2:], size, strict=True))
    with torch.autocast(images.device.type, enabled=False):
        return rows.mT @ (images @ columns)


@cache
def _shares(side: int, parts: int, device: torch.device) -> Tensor:
    """The weight of each pixel of a side in each of its parts, ``[side, parts]``."""
    return functional.adaptive_avg_pool1d(torch.eye(side, device=device), parts)


class VectorDecoder(Decoder):
    r"""Predicts a vector; the error is the mean squared error of :math:`\text{sign}(x) \ln(1 + |x|)` (symlog).

    So entries of any size can be predicted side by side (DreamerV3; Hafner et al., 2023).

    Args:
        in_features: D.
        size: number of the vector's entries.
        scaling: applied to the vector first; ``None``: nothing is.

    Examples:
        >>> VectorDecoder(8, size=4).error(torch.zeros(2, 3, 8), torch.zeros(2, 3, 4)).shape
        torch.Size([2, 3])
    """

    def __init__(self, in_features: int, size: int, scaling: nn.Module | None = None) -> None:
        super().__init__()
        check_size("in_features", in_features, 128)
        check_size("size", size, "the number of the vector's entries")
        self.scaling = scaling or nn.Identity()
        self.entries = nn.Linear(in_features, size)

    def error(self, vector: Tensor, observation: Tensor) -> Tensor:
        return (self.entries(vector).float() - symlog(self.scaling(observation.float()))).square().mean(-1)


def symlog(value: Tensor) -> Tensor:
    """``sign(x) ln(1 + |x|)``: like x near 0, like a logarithm far from it.

    Examples:
        >>> symlog(torch.tensor([0.0, -1.0, 1e6]))
        tensor([ 0.0000, -0.6931, 13.8155])
    """
    return value.sign() * value.abs().log1p()
