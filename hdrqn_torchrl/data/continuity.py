"""Checks that collected batches are what memories assume: the same worlds, continued from batch to batch."""

from __future__ import annotations

from functools import partial

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from hdrqn_torchrl import keys
from hdrqn_torchrl.devices import LateCheck


class Continuity:
    """Checks batches ``[N, T]`` as they come and refuses those that would silently be learned from wrongly.

    Each row must go on where it ended in the last batch, in the same episode, unless that one was over or a new one
    begins. Rows of two collectors do not: what began in a world of one would end in a world of the other. And where an
    episode ends, so must its option; a time limit behind :class:`~hdrqn_torchrl.transforms.SubgoalTransform` leaves it
    open. Nor may a collector act without the policy, which writes its memory and what it did:
    ``Collector(init_random_frames=...)`` begins so.

    Args:
        memory_key: recurrent state of the policy ``[H]``, which goes on in each step; ``None``: it has none.
        traj_key: number of the episode.
        init_key: first step of an episode.
        option_done_key: under ``"next"``, for hierarchical agents.

    Examples:
        >>> from tensordict import TensorDict
        >>> no, episode = torch.zeros(2, 3, 1, dtype=torch.bool), torch.tensor([[0, 0, 0], [1, 1, 1]])
        >>> batch = TensorDict({"collector": {"traj_ids": episode}, "is_init": no, "next": {"done": no}}, [2, 3])
        >>> continuity = Continuity()
        >>> continuity.check(batch)
        >>> continuity.check(batch.flip(0))
        Traceback (most recent call last):
        ValueError: batch must go on where the last one ended, ...
    """

    def __init__(
        self,
        *,
        memory_key: NestedKey | None = None,
        traj_key: NestedKey = keys.TRAJ_IDS,
        init_key: NestedKey = keys.IS_INIT,
        option_done_key: NestedKey = keys.OPTION_DONE,
    ) -> None:
        self.memory_key, self.traj_key = memory_key, traj_key
        self.init_key, self.option_done_key = init_key, option_done_key
        self._check = LateCheck()
        self.reset()

    def reset(self) -> None:
        """Accepts any next batch."""
        self._episode: Tensor | None = None  # [N, 1]: that of the last step, ...
        self._over: Tensor | None = None  # [N, 1]: ... and whether it was over
        self._check.forget()

    def check(self, batch: TensorDictBase) -> None:
        """Looks at the next batch.

        Raises:
            ValueError: if it does not continue the last one; on a GPU, the next call says so.
        """
        if batch.ndim != 2:
            raise ValueError(
                f"batch must be [N, T], N environments and T steps of each, got {list(batch.shape)}; give one "
                "Collector all environments, as the batches of several can't be told apart in a memory."
            )
        episode = batch.get(self.traj_key, None)
        if episode is None:
            raise ValueError(f"batch must number its episodes in {self.traj_key}; use Collector(track_traj_ids=True).")
        if self._episode is not None and len(self._episode) != len(episode):
            raise ValueError(f"batch must hold the same {len(self._episode)} environments, got {len(episode)}.")
        over = batch.get("next").get(keys.DONE).squeeze(-1)
        before = episode[:, :1] if self._episode is None else self._episode
        over_before = torch.zeros_like(over[:, :1]) if self._over is None else self._over
        episodes, ends = torch.cat([before, episode], 1), torch.cat([over_before, over], 1)
        jumps = (episodes[:, 1:] != episodes[:, :-1]) & ~ends[:, :-1]
        starts = batch.get(self.init_key, None)
        if starts is not None:  # an episode that is over does not go on
            jumps = (jumps | ends[:, :-1]) & ~starts.squeeze(-1)
        option_done = batch.get("next").get(self.option_done_key, None)
        left_open = torch.zeros_like(over) if option_done is None else over & ~option_done.squeeze(-1)
        wrong, idle = (jumps | left_open).any(), None
        if self._episode is None:
            idle = self._is_idle(batch)
            wrong = wrong | idle
        self._check.ask(wrong, partial(_refuse, idle, jumps, left_open, episodes, ends))
        self._episode, self._over = episode[:, -1:].clone(), over[:, -1:].clone()

    def _is_idle(self, batch: TensorDictBase) -> Tensor:
        """Whether the policy's memory stands still in all episodes that begin with the batch, ``[]`` bool.

        There it was zero, and moves; later it may have come to rest. Batches of one step don't show it.
        """
        memory = None if self.memory_key is None else batch.get(self.memory_key, None)
        starts = batch.get(self.init_key, None)
        if memory is None or starts is None or batch.shape[1] < 2:
            return torch.zeros((), dtype=torch.bool, device=batch.get(self.traj_key).device)
        begun = starts[:, 0].squeeze(-1) & ~starts[:, 1].squeeze(-1)
        moved = (memory[:, 0] != memory[:, 1]).any(-1)
        return begun.any() & ~(moved & begun).any()


def _refuse(idle: Tensor | None, jumps: Tensor, left_open: Tensor, episodes: Tensor, ends: Tensor) -> None:
    if idle is not None and idle:
        raise ValueError(
            "the policy must act in every step, got a batch in which its memory stands still; collect without "
            "init_random_frames: the policy's own exploration begins at random."
        )
    if left_open.any():
        raise ValueError(
            "each end of an episode must end its option, got one that did not; a time limit must come before the "
            "agent's transforms: agent.transform(TransformedEnv(env, StepCounter(max_steps=...))), and not behind "
            "them, as Collector(max_frames_per_traj=...) or as Collector(set_truncated=True)."
        )
    row, time = jumps.nonzero()[0].tolist()
    one_collector = "give one Collector all environments instead of using several"
    if ends[row, time]:
        between = f", and {one_collector}" if time == 0 else ""  # the last batch may have been another collector's
        raise ValueError(
            f"batch must begin a new episode where one is over, got the middle of episode "
            f"{int(episodes[row, time + 1])} after the end of episode {int(episodes[row, time])} (environment {row}, "
            f"step {time}); collect without set_truncated=True{between}."
        )
    raise ValueError(
        f"batch must go on where the last one ended, in every environment, got the middle of episode "
        f"{int(episodes[row, time + 1])} after a step of episode {int(episodes[row, time])}, which was not over "
        f"(environment {row}, step {time}); a learner takes the batches of one collector, all and in order: "
        f"{one_collector}."
    )
