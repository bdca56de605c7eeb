"""A recurrent predictor of the next view, apart from any agent."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, one_hot


class Predictor(nn.Module):
    """An LSTM and a hidden layer of 128 units each, as v3 has by default: the next view from all before and the action.

    Args:
        places: of a view.
        codes: of a place.
        actions: number of them.
    """

    def __init__(self, places: int, codes: int, actions: int) -> None:
        super().__init__()
        self.actions, self.shape = actions, (places, codes)
        self.memory = nn.LSTM(places * codes + actions, 128, batch_first=True)
        self.head = nn.Sequential(nn.Linear(128 + actions, 128), nn.ReLU(), nn.Linear(128, places * codes))

    def forward(self, views: Tensor, action: Tensor) -> Tensor:
        """Logits ``[B, T, P, C]`` of what follows views ``[B, T, P, C]`` (one-hot) and actions ``[B, T]``."""
        taken = one_hot(action, self.actions).float()
        before = torch.cat([torch.zeros_like(taken[:, :1]), taken[:, :-1]], 1)
        memory, _ = self.memory(torch.cat([views.flatten(-2), before], -1))
        return self.head(torch.cat([memory, taken], -1)).unflatten(-1, self.shape)


def errors(logits: Tensor, after: Tensor) -> Tensor:
    """Cross-entropy of all places of a view together, ``[B, T]``."""
    flat = cross_entropy(logits.flatten(0, -2), after.argmax(-1).flatten(), reduction="none")
    return flat.view(after.shape[:-1]).sum(-1)
