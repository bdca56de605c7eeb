"""Clusters of steps, and how well the best of them matches a goal."""

from __future__ import annotations

import torch
from torch import Tensor


def k_means(points: Tensor, k: int, restarts: int = 3) -> Tensor:
    """The cluster of each point ``[M, D]``, the best of some starts (k-means++)."""
    best, labels = float("inf"), torch.zeros(len(points), dtype=torch.int64)
    for _ in range(restarts):
        centers = points[torch.randint(len(points), (1,))]
        while len(centers) < k:
            nearest = torch.cdist(points, centers).amin(1).square() + 1e-9
            centers = torch.cat([centers, points[torch.multinomial(nearest, 1)]])
        for _ in range(30):
            label = torch.cdist(points, centers).argmin(1)
            sums = torch.zeros_like(centers).index_add_(0, label, points)
            counts = torch.bincount(label, minlength=k).unsqueeze(-1)
            centers = torch.where(counts > 0, sums / counts.clamp(min=1), centers)
        cost = torch.cdist(points, centers).amin(1).square().sum().item()
        if cost < best:
            best, labels = cost, label
    return labels


def scored(true: Tensor, rows: Tensor, events: Tensor) -> str:
    """Mean over goals of precision and recall of the event with the best F1.

    Args:
        true: goals taken in all steps ``[M, G]`` bool.
        rows: steps in which there are events ``[L]``.
        events: those of each ``[L, E]``.
    """
    both, events = true[rows].double().T @ events.double(), events.double()
    precision, recall = both / events.sum(0).clamp(min=1), both / true.sum(0).unsqueeze(-1)
    best = (2 * precision * recall / (precision + recall).clamp(min=1e-9)).argmax(-1, keepdim=True)
    return f"{precision.gather(-1, best).mean():.2f} / {recall.gather(-1, best).mean():.2f}"
