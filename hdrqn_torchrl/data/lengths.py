"""How long stored episodes are."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from hdrqn_torchrl import keys


class LongerEpisodes:
    """Looks out for an episode of more than so many transitions among those that are stored.

    Args:
        length: transitions of an episode that is not longer.
        init_key: first transition of an episode.
    """

    def __init__(self, length: int, *, init_key: NestedKey = keys.IS_INIT) -> None:
        self.length, self.init_key = length, init_key
        self._age: Tensor | None = None  # [N, 1]: transitions of the episode in progress

    def seen(self, transitions: TensorDictBase) -> bool:
        """Whether there is one in ``[N, T]``, which go on where those before ended, or in ``[M]``.

        Examples:
            >>> from tensordict import TensorDict
            >>> longer, steps = LongerEpisodes(3), TensorDict(is_init=torch.zeros(1, 2, 1).bool(), batch_size=[1, 2])
            >>> longer.seen(steps), longer.seen(steps)
            (False, True)
        """
        init = transitions.get(self.init_key).squeeze(-1)
        rows = init.ndim == 1
        if rows:
            init, self._age = init.unsqueeze(0), None
        before = torch.zeros_like(init[:, :1], dtype=torch.int64) if self._age is None else self._age
        step = torch.arange(init.shape[1], device=init.device)
        start = torch.where(init, step, -1).cummax(1).values
        age = torch.where(start < 0, before + step + 1, step - start + 1)
        self._age = age[:, -1:]
        return bool((age > self.length).any())
