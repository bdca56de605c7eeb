"""How long stored episodes are."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from hdrqn_torchrl import keys


class LongerEpisodes:
    """Looks out for an episode of more transitions than a sequence has, among those that are stored.

    Args:
        length: transitions of a sequence.
        init_key: first transition of an episode.
        done_key, terminated_key: under ``"next"``; of rows, those that are done and not terminated hold no transition
            (:class:`~hdrqn_torchrl.data.OptionExtractor`).
    """

    def __init__(
        self,
        length: int,
        *,
        init_key: NestedKey = keys.IS_INIT,
        done_key: NestedKey = keys.DONE,
        terminated_key: NestedKey = keys.TERMINATED,
    ) -> None:
        self.length, self.init_key, self.done_key, self.terminated_key = length, init_key, done_key, terminated_key
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
        if init.ndim == 1:
            after = transitions.get("next")
            final = (after.get(self.done_key) & ~after.get(self.terminated_key)).squeeze(-1)
            init, self._age = init[~final].unsqueeze(0), None
        if not init.shape[1]:
            return False
        before = torch.zeros_like(init[:, :1], dtype=torch.int64) if self._age is None else self._age
        step = torch.arange(init.shape[1], device=init.device)
        start = torch.where(init, step, -1).cummax(1).values
        age = torch.where(start < 0, before + step + 1, step - start + 1)
        self._age = age[:, -1:]
        return bool((age > self.length).any())
