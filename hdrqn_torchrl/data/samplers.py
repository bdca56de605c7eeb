"""How sequences are drawn from a replay memory: which steps may start one, and how far it goes on."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import SliceSampler, Storage

from hdrqn_torchrl import keys
from hdrqn_torchrl.data.slices import episode_starts, padded_slices, steps_left, steps_passed
from hdrqn_torchrl.modules.sizes import check_size


class StepSliceSampler(SliceSampler):
    """Slices that start at a uniformly random *step*; TorchRL's ``SliceSampler`` picks an episode first.

    How long an episode lasts depends on what happened in it. To pick episodes uniformly shows each step of a
    short (say, successful) episode more often than it occurs, and shows its last steps less often than those in
    its middle; Q-values of a stochastic task are then biased. Here whether a step is shown depends on its past
    only. A slice that meets the end of its episode is padded and ``("collector", "mask")`` marks its real steps.

    Args:
        slice_len: steps of a slice.
        traj_key: entry that numbers the episodes.
        terminated_key: if given, the last stored step of an episode starts no slice unless this flag is set: what it
            led to is not stored, so that there would be nothing to learn from.

    Examples:
        >>> from tensordict import TensorDict
        >>> sampler = StepSliceSampler(slice_len=4, traj_key="episode")
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), sampler=sampler, batch_size=8)
        >>> _ = buffer.extend(TensorDict(episode=torch.tensor([0, 0, 0, 1, 1]), batch_size=5))
        >>> buffer.sample().reshape(2, 4)["collector", "mask"].shape
        torch.Size([2, 4])
    """

    def __init__(
        self, *, slice_len: int, traj_key: NestedKey = keys.TRAJ_IDS, terminated_key: NestedKey | None = None
    ) -> None:
        check_size("slice_len", slice_len, 8)
        super().__init__(
            slice_len=slice_len,
            traj_key=traj_key,
            truncated_key=None,
            init_key=None,
            cache_values=True,
            strict_length=False,
            pad_output=True,
        )
        self.terminated_key = terminated_key
        self._found: tuple[int, _Episodes] | None = None  # revision of the storage, and what it holds then

    def sample(self, storage: Storage, batch_size: int) -> tuple[tuple[Tensor, ...], dict[NestedKey, Any]]:
        """Draws ``batch_size // slice_len`` slices; returns their indices, one tensor per storage dimension."""
        first, lengths, starts, total = self._episodes(storage)
        length, count = self._adjusted_batch_size(batch_size)
        ends = starts.cumsum(0)
        step = torch.randint(total, (count,), device=ends.device, generator=self._rng)
        episode = torch.searchsorted(ends, step, right=True)
        passed = step - ends[episode] + starts[episode]  # steps of the episode before the slice
        start = first[episode]
        start[:, 0] += passed
        return padded_slices(start, lengths[episode] - passed, length, rows=storage.shape[0])

    def can_sample(self, storage: Storage) -> bool:
        """Whether there is a slice to draw from a storage that is not empty."""
        return len(self._episodes(storage).first) > 0

    def weights(self, storage: Storage) -> tuple[Tensor, Tensor | None]:
        """How likely each stored step starts a slice, and how many steps of its episode are left from there on.

        The same as :meth:`sample` draws by, in shapes that do not depend on what is stored: ``[rows, N]``.
        """
        left, starts, _ = self._steps(storage)
        return starts.double(), left

    def _steps(self, storage: Storage) -> tuple[Tensor, Tensor, Tensor]:
        """Of each stored step: steps left, whether a slice can start, whether the last stored one counts as a start."""
        rows, newest = (len(storage[:]), -1), storage._last_cursor_index  # type: ignore[attr-defined]
        episode = storage[:].get(self.traj_key).view(rows)
        known = torch.ones_like(episode, dtype=torch.bool)
        if self.terminated_key is not None:
            known = storage[:].get(self.terminated_key).view(rows)
        left, counts = steps_left(episode, known, newest)
        return left, counts | (left > 1), counts

    def _episodes(self, storage: Storage) -> _Episodes:
        """The stored episodes in which a slice can start."""
        if self._found is None or self._found[0] != storage._mutation_revision:
            self._found = storage._mutation_revision, self._find(storage)
        return self._found[1]

    def _find(self, storage: Storage) -> _Episodes:
        first, stop, lengths = self._get_stop_and_length(storage)
        if self.terminated_key is None:
            return _Episodes(first, lengths, lengths, int(lengths.sum()))
        terminated = storage[:].get(self.terminated_key)[stop.unbind(-1)].flatten()
        starts = lengths - (~terminated).long()
        known = starts.nonzero().squeeze(-1)
        return _Episodes(first[known], lengths[known], starts[known], int(starts.sum()))


class _Episodes(NamedTuple):
    """Episodes of a storage."""

    first: Tensor
    """Where their first stored steps are, ``[E, ndim]``."""
    lengths: Tensor
    """How many steps of each are stored, ``[E]``."""
    starts: Tensor
    """At how many of them, from the first on, a slice can start, ``[E]``."""
    total: int
    """At how many of all; the host reads it once after a write instead of at every draw."""


class EpisodeSliceSampler(StepSliceSampler):
    """Slices from a random place of a random *episode*, as the paper has it (and TorchRL's ``SliceSampler``).

    The place is such that the episode, if it is long enough, goes on for the whole slice.

    Args:
        slice_len: steps of a slice.
        lookahead: how many of them, at its end, do not influence where it begins; they are padding where the episode is
            over. So an episode's last steps are shown before these as well.
        traj_key, terminated_key: as in :class:`StepSliceSampler`.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> sampler = EpisodeSliceSampler(slice_len=3, traj_key="episode")
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), sampler=sampler, batch_size=6)
        >>> steps = {"episode": torch.zeros(5, dtype=torch.int64), "step": torch.arange(5)}
        >>> _ = buffer.extend(TensorDict(steps, [5]))
        >>> sample = buffer.sample().reshape(2, 3)
        >>> sample["step"] - sample["step"][:, :1]  # always whole, as the episode is long enough
        tensor([[0, 1, 2],
                [0, 1, 2]])
    """

    def __init__(
        self,
        *,
        slice_len: int,
        lookahead: int = 0,
        traj_key: NestedKey = keys.TRAJ_IDS,
        terminated_key: NestedKey | None = None,
    ) -> None:
        super().__init__(slice_len=slice_len, traj_key=traj_key, terminated_key=terminated_key)
        if not 0 <= lookahead < slice_len:
            raise ValueError(f"lookahead must lie in [0, slice_len={slice_len}), got {lookahead}; 0 is none.")
        self.lookahead = lookahead

    def sample(self, storage: Storage, batch_size: int) -> tuple[tuple[Tensor, ...], dict[NestedKey, Any]]:
        """Draws ``batch_size // slice_len`` slices; returns their indices, one tensor per storage dimension."""
        first, lengths, starts, _ = self._episodes(storage)
        length, count = self._adjusted_batch_size(batch_size)
        episode = torch.randint(len(lengths), (count,), device=lengths.device, generator=self._rng)
        start = first[episode]
        places = (starts[episode] - (length - self.lookahead)).clamp(min=0) + 1
        passed = (torch.rand(count, device=lengths.device, generator=self._rng) * places).floor().to(start.dtype)
        start[:, 0] += passed
        return padded_slices(start, lengths[episode] - passed, length, rows=storage.shape[0])

    def weights(self, storage: Storage) -> tuple[Tensor, Tensor | None]:
        """As those of :class:`StepSliceSampler`; all places of an episode together have the weight 1."""
        left, starts, counts = self._steps(storage)
        passed = steps_passed(storage[:].get(self.traj_key).view(left.shape), storage._last_cursor_index)  # type: ignore[attr-defined]
        places = (passed + left - (~counts).long() - (self.slice_len - self.lookahead)).clamp(min=0) + 1
        return torch.where(starts & (passed < places), 1.0 / places.double(), 0.0), left


class WholeEpisodeSampler(StepSliceSampler):
    """Slices that start where a random episode starts, padded after its end.

    Like :class:`EpisodeStartSampler` where the recurrent state of every step is exact; here each slice shows one
    episode, so that short episodes leave room unused, and storages of one dimension (options) will do, too.

    Args:
        slice_len: steps of a slice; an episode's later steps are never shown.
        init_key: first step of an episode.
        traj_key, terminated_key: as in :class:`StepSliceSampler`.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> sampler = WholeEpisodeSampler(slice_len=4, traj_key="episode")
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), sampler=sampler, batch_size=8)
        >>> steps = {"episode": torch.tensor([0, 0, 0]), "is_init": torch.tensor([True, False, False])}
        >>> _ = buffer.extend(TensorDict(steps, [3]))
        >>> buffer.sample().reshape(2, 4)["collector", "mask"]
        tensor([[ True,  True,  True, False],
                [ True,  True,  True, False]])
    """

    def __init__(
        self,
        *,
        slice_len: int,
        init_key: NestedKey = keys.IS_INIT,
        traj_key: NestedKey = keys.TRAJ_IDS,
        terminated_key: NestedKey | None = None,
    ) -> None:
        super().__init__(slice_len=slice_len, traj_key=traj_key, terminated_key=terminated_key)
        self.first_key = init_key

    def sample(self, storage: Storage, batch_size: int) -> tuple[tuple[Tensor, ...], dict[NestedKey, Any]]:
        """Draws ``batch_size // slice_len`` slices; returns their indices, one tensor per storage dimension."""
        length, count = self._adjusted_batch_size(batch_size)
        first, lengths, *_ = self._episodes(storage)
        if not len(first):  # the ring has overwritten the beginning of every episode
            raise RuntimeError("no stored episode has its first step; raise capacity above the length of an episode.")
        chosen = torch.randint(len(first), (count,), device=first.device, generator=self._rng)
        return padded_slices(first[chosen], lengths[chosen], length, rows=storage.shape[0])

    def weights(self, storage: Storage) -> tuple[Tensor, Tensor | None]:
        """As those of :class:`StepSliceSampler`."""
        left, starts, _ = self._steps(storage)
        return (starts & storage[:].get(self.first_key).view(left.shape)).double(), left

    def _find(self, storage: Storage) -> _Episodes:
        """Those whose first step is stored."""
        found = super()._find(storage)
        whole = storage[:].get(self.first_key)[found.first.unbind(-1)].flatten().nonzero().squeeze(-1)
        starts = found.starts[whole]
        return _Episodes(found.first[whole], found.lengths[whole], starts, int(starts.sum()))


class EpisodeStartSampler(SliceSampler):
    """Slices that start where a random episode starts, and run on into the next ones if it is shorter.

    The recurrent state of every step is exact, no step is padding, and whether a step is shown depends on its past only
    (see :class:`StepSliceSampler`). Needs a storage of two dimensions (time, environment).

    Args:
        slice_len: steps of a slice; an episode's later steps are never shown.
        init_key: first step of an episode.
        traj_key: entry that numbers the episodes.
        done_key: last step of an episode.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> sampler = EpisodeStartSampler(slice_len=4, traj_key="episode")
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20, ndim=2), sampler=sampler, batch_size=8)
        >>> episode = torch.tensor([[0, 0, 0, 1, 1]])  # of one environment
        >>> init = torch.tensor([[True, False, False, True, False]]).unsqueeze(-1)
        >>> steps = {"episode": episode, "is_init": init, "next": {"done": init.roll(-1, 1)}}
        >>> _ = buffer.extend(TensorDict(steps, [1, 5]))
        >>> buffer.sample().reshape(2, 4)["episode"]  # too few steps follow the start of the second one
        tensor([[0, 0, 0, 1],
                [0, 0, 0, 1]])
    """

    def __init__(
        self,
        *,
        slice_len: int,
        init_key: NestedKey = keys.IS_INIT,
        traj_key: NestedKey = keys.TRAJ_IDS,
        done_key: NestedKey = ("next", keys.DONE),
    ) -> None:
        check_size("slice_len", slice_len, 8)
        super().__init__(slice_len=slice_len, traj_key=traj_key, truncated_key=None, init_key=None, cache_values=True)
        self.first_key, self.done_key = init_key, done_key

    def sample(self, storage: Storage, batch_size: int) -> tuple[tuple[Tensor, ...], dict[NestedKey, Any]]:
        """Draws ``batch_size // slice_len`` slices; returns their indices, one tensor per storage dimension."""
        length, count = self._adjusted_batch_size(batch_size)
        time, environment = self._starts(storage)
        if not len(time):
            raise RuntimeError(
                f"no stored start of an episode begins slice_len={length} stored steps; update later, raise capacity "
                "or use shorter slices."
            )
        chosen = torch.randint(len(time), (count,), device=time.device, generator=self._rng)
        times = time[chosen].unsqueeze(-1) + torch.arange(length, device=time.device)
        return ((times % storage.shape[0]).flatten(), environment[chosen].repeat_interleave(length)), {}

    def weights(self, storage: Storage) -> tuple[Tensor, Tensor | None]:
        """As those of :class:`StepSliceSampler`; no slice ends early."""
        return self._are_starts(storage, self.slice_len).double(), None

    def can_sample(self, storage: Storage) -> bool:
        """Whether enough steps follow a start of an episode in a storage that is not empty."""
        return len(self._starts(storage)[0]) > 0

    def _starts(self, storage: Storage) -> tuple[Tensor, Tensor]:
        """Time and environment of the starts that can be drawn."""
        contents = storage._mutation_revision
        if contents not in self._cache:
            self._cache.clear()
            self._cache[contents] = self._find_starts(storage, self.slice_len)
        return self._cache[contents]

    def _find_starts(self, storage: Storage, length: int) -> tuple[Tensor, Tensor]:
        return self._are_starts(storage, length).nonzero(as_tuple=True)  # type: ignore[return-value]

    def _are_starts(self, storage: Storage, length: int) -> Tensor:
        steps = storage[:].select(self.first_key, self.traj_key, self.done_key)
        init, episode, done = (steps.get(key) for key in (self.first_key, self.traj_key, self.done_key))
        return episode_starts(init.squeeze(-1), episode, done.squeeze(-1), storage._last_cursor_index, length)
