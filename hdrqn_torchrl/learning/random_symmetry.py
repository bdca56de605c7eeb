"""Sequences as they would be in worlds that are turned or mirrored."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from hdrqn_torchrl.envs.symmetry import Symmetry, with_identity


class RandomSymmetry:
    """Changes each sequence of a minibatch by one of a task's symmetries, or not at all, all with the same probability.

    It is the ``refresh`` of a :class:`~hdrqn_torchrl.learning.Learner`, and no transform of its replay buffer: a
    buffer's transforms see single steps, and a sequence must be changed as a whole.

    Args:
        symmetries: of the task, at least one.
        observation_key: entry ``[B, T, ...]`` whose places change.
        action_keys: entries ``[B, T]`` int64 of actions.
        mask_keys: entries ``[B, T, A]`` that say something about each action.
        device: of the minibatches.

    Examples:
        >>> from tensordict import TensorDict
        >>> mirror = Symmetry(places=(2, 1, 0), actions=(1, 0))
        >>> change = RandomSymmetry([mirror], observation_key="observation", action_keys=["action"])
        >>> left = TensorDict({"observation": torch.tensor([[[1, 0, 0]]]), "action": torch.tensor([[0]])}, [1, 1])
        >>> changed = change(left)
        >>> changed["action"].item() == changed["observation"][0, 0, 2].item()
        True
    """

    def __init__(
        self,
        symmetries: Sequence[Symmetry],
        *,
        observation_key: NestedKey,
        action_keys: Sequence[NestedKey],
        mask_keys: Sequence[NestedKey] = (),
        device: torch.device | str | None = None,
    ) -> None:
        if not symmetries:
            raise ValueError("symmetries must be those of a task, at least one, got none; leave RandomSymmetry out.")
        every = with_identity(symmetries)
        self._places = torch.tensor([each.places for each in every], device=device)
        self._actions = torch.tensor([each.actions for each in every], device=device)
        self._were = self._actions.argsort(-1)  # for each action of the changed world, which one it was
        self.observation_key, self.action_keys, self.mask_keys = observation_key, list(action_keys), list(mask_keys)

    def __call__(self, sample: TensorDictBase) -> TensorDictBase:
        """The minibatch ``[B, T]`` with other observations and actions; the given one stays as it is."""
        drawn = torch.randint(len(self._places), sample.shape[:1], device=self._places.device)
        changed = sample.copy()
        observation = sample[self.observation_key]
        places = observation.flatten(2)
        changed[self.observation_key] = _look_up(places, self._places[drawn].unsqueeze(1)).view_as(observation)
        for key in self.action_keys:
            changed[key] = self._actions[drawn].gather(1, sample[key])
        for key in self.mask_keys:
            changed[key] = _look_up(sample[key], self._were[drawn].unsqueeze(1))
        return changed


def _look_up(entries: Tensor, index: Tensor) -> Tensor:
    return entries.gather(-1, index.expand(entries.shape))
