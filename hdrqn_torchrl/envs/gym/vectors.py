"""Vectors of worlds: one way to reset some and step all of them, whoever made the vector."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.gym.masks import MaskPlace
from hdrqn_torchrl.envs.gym.worlds import Entries, Reading, World

Mask = NDArray[np.bool_]
_LARGEST_SEED = 2**31


def _scattered(seed: int) -> int:
    """A seed for makers of worlds that count on from it: those of neighbouring seeds would share all worlds but one."""
    return int(np.random.default_rng(seed).integers(_LARGEST_SEED))


class Outcome(NamedTuple):
    """What a step of N worlds returns, ``[N, ...]`` each."""

    entries: Entries
    reward: NDArray[np.float32]
    terminated: Mask
    truncated: Mask


class Worlds(Protocol):
    """N worlds that, as far as an agent can see, never begin a new episode by themselves."""

    def seed(self, seed: int) -> None:
        """The next reset, which is one of all worlds, and all that follows depends on ``seed`` alone."""

    def reset(self, mask: Mask) -> Entries:
        """New episodes where ``mask`` is set; returns entries of all worlds, which hold only there."""

    def step(self, actions: NDArray[np.int64]) -> Outcome:
        """One step of all."""

    def state_dict(self) -> dict[str, Any] | None:
        """What brings the episodes in progress back; ``None`` if nothing does."""

    def load_state_dict(self, state: Mapping[str, Any]) -> Entries | None:
        """Brings them back; returns what the worlds show then, or ``None`` if they cannot be brought back."""


class OwnWorlds:
    """A vector of :class:`~hdrqn_torchrl.envs.gym.worlds.WorldWrapper`: every episode has a seed of its own.

    Args:
        vector: in this process or with one for each world, with ``AutoresetMode.DISABLED``.
    """

    def __init__(self, vector: SyncVectorEnv | AsyncVectorEnv) -> None:
        self.vector = vector
        self._generator = np.random.default_rng()

    def seed(self, seed: int) -> None:
        """See :class:`Worlds`."""
        self._generator = np.random.default_rng(seed)

    def reset(self, mask: Mask) -> Entries:
        """See :class:`Worlds`."""
        seeds = np.zeros(len(mask), np.int64)
        seeds[mask] = self._generator.integers(_LARGEST_SEED, size=mask.sum())
        with _processes_watched():
            entries, _ = self.vector.reset(seed=list(seeds.tolist()), options={"reset_mask": mask.copy()})
        return entries

    def step(self, actions: NDArray[np.int64]) -> Outcome:
        """See :class:`Worlds`."""
        with _processes_watched():
            entries, reward, terminated, truncated, _ = self.vector.step(actions)
        return Outcome(entries, reward.astype(np.float32), terminated, truncated)

    def state_dict(self) -> dict[str, Any] | None:
        """See :class:`Worlds`."""
        moments = list(self.vector.get_attr("moment"))
        if any(moment is None for moment in moments):
            return None
        return {"moments": moments, "generator": self._generator.bit_generator.state}

    def load_state_dict(self, state: Mapping[str, Any]) -> Entries | None:
        """See :class:`Worlds`."""
        self.vector.reset()  # no world is over then
        self.vector.set_attr("moment", list(state["moments"]))
        if any(self.vector.get_attr("lost")):
            return None
        self._generator.bit_generator.state = state["generator"]
        shown = self.vector.get_attr("entries")
        return _stacked(shown)


@contextmanager
def _processes_watched() -> Iterator[None]:
    """Says what has happened where the pipe to a world's process is broken."""
    try:
        yield
    except (EOFError, ConnectionError) as error:
        raise RuntimeError(
            "the process of a world (processes=True) has ended; was it killed, or was there too little memory?"
        ) from error


class _WithoutState:
    """Worlds that cannot be brought back after a restart, whatever was stored."""

    def state_dict(self) -> None:
        """See :class:`Worlds`."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See :class:`Worlds`."""


class GivenWorlds(_WithoutState):
    """A vector that was made elsewhere. Its worlds cannot be looked into, nor brought back after a restart.

    Args:
        vector: any of Gymnasium's, in any autoreset mode. One that resets in the next step must be able to reset some
            of its worlds (``SyncVectorEnv``, ``AsyncVectorEnv``).
        reading: how entries are read.

    Raises:
        ValueError: if it cannot.
    """

    def __init__(self, vector: VectorEnv, reading: Reading) -> None:
        self.vector = vector
        self._mode = (vector.metadata or {}).get("autoreset_mode", AutoresetMode.NEXT_STEP)
        if self._mode == AutoresetMode.NEXT_STEP and not isinstance(vector.unwrapped, SyncVectorEnv | AsyncVectorEnv):
            raise ValueError(
                f"id must be a vector that can reset some of its worlds, got {type(vector.unwrapped).__name__}, which "
                "resets in the next step; use its SAME_STEP or DISABLED mode, or the id of a single environment."
            )
        self._worlds = [World(reading) for _ in range(vector.num_envs)]
        self._begun: dict[int, Entries] = {}  # worlds that began anew in the step that ended an episode
        self._rows: list[Entries] = [{} for _ in self._worlds]
        self._seed: int | None = None

    def seed(self, seed: int) -> None:
        """See :class:`Worlds`."""
        self._seed, self._begun = _scattered(seed), {}

    def reset(self, mask: Mask) -> Entries:
        """See :class:`Worlds`."""
        chosen = mask.nonzero()[0].tolist()
        if not self._begun.keys() >= set(chosen):
            self._begin(mask, chosen)
        for index in chosen:
            self._rows[index] = self._begun.pop(index)
        return _stacked(self._rows)

    def _begin(self, mask: Mask, chosen: Sequence[int]) -> None:
        """New episodes by the vector's own ``reset``."""
        if not mask.all() and self._mode == AutoresetMode.SAME_STEP:
            raise ValueError(
                "a vector that resets in the same step cannot reset some worlds before their episodes end."
            )
        shown, info = self.vector.reset(seed=self._seed, options=None if mask.all() else {"reset_mask": mask.copy()})
        self._seed = None
        for index in chosen:
            self._begun[index] = self._worlds[index].begin(self._shown(shown, index), _info_of(info, index))

    def _shown(self, batch: Any, index: int) -> Any:
        """What one world shows."""
        return _row(batch, index, self.vector.single_observation_space)

    def step(self, actions: NDArray[np.int64]) -> Outcome:
        """See :class:`Worlds`."""
        shown, reward, terminated, truncated, info = self.vector.step(actions)
        rewards, same_step = np.zeros(len(self._worlds), np.float32), self._mode == AutoresetMode.SAME_STEP
        for index, world in enumerate(self._worlds):
            after, told = self._shown(shown, index), _info_of(info, index)
            begun, about_begun = after, told
            if resets := same_step and (terminated[index] or truncated[index]):
                after, told = told["final_obs"], told.get("final_info", {})
            ends = terminated[index], truncated[index]
            self._rows[index], rewards[index], *_ = world.step(after, reward[index], *ends, told)
            if resets:
                self._begun[index] = world.begin(begun, about_begun)
        return Outcome(_stacked(self._rows), rewards, terminated, truncated & ~terminated)


class PooledWorlds(_WithoutState):
    """Worlds of EnvPool, which are stepped in C++. They cannot be looked into, nor brought back after a restart.

    Args:
        make: makes a pool for a seed, with Gymnasium's interface.
        reading: how entries are read.
        num_envs: N.
        space: of the observations of one world.
        mask: where pools tell which actions can be chosen; ``None``: nowhere.
    """

    def __init__(
        self,
        make: Callable[[int], Any],
        reading: Reading,
        num_envs: int,
        *,
        space: gymnasium.Space,
        mask: MaskPlace | None = None,
    ) -> None:
        self._make, self._space, self._mask = make, space, mask
        self.pool: Any = None  # until there is a seed
        self._worlds = [World(reading) for _ in range(num_envs)]
        self._rows: list[Entries] = [{} for _ in self._worlds]

    def seed(self, seed: int) -> None:
        """See :class:`Worlds`. A pool takes a seed only when it is made."""
        if self.pool is not None:
            self.pool.close()
        self.pool = self._make(_scattered(seed))

    def reset(self, mask: Mask) -> Entries:
        """See :class:`Worlds`."""
        chosen = mask.nonzero()[0].astype(np.int32)
        shown, info = self.pool.reset(chosen)
        for place, index in enumerate(chosen):
            self._rows[index] = self._worlds[index].begin(self._shown(shown, place), self._told(shown, info, place))
        return _stacked(self._rows)

    def step(self, actions: NDArray[np.int64]) -> Outcome:
        """See :class:`Worlds`."""
        shown, reward, terminated, truncated, info = self.pool.step(actions.astype(np.int32))
        rewards = np.zeros(len(self._worlds), np.float32)
        for index, world in enumerate(self._worlds):
            ends, told = (terminated[index], truncated[index]), self._told(shown, info, index)
            self._rows[index], rewards[index], *_ = world.step(self._shown(shown, index), reward[index], *ends, told)
        return Outcome(_stacked(self._rows), rewards, terminated, truncated & ~terminated)

    def _shown(self, batch: Any, index: int) -> Any:
        """What one world shows."""
        return _row(batch, index, self._space)

    def _told(self, shown: Any, info: Mapping[str, Any], index: int) -> dict[str, Any]:
        """One world's ``info``, with the mask of its actions where agents look for it."""
        told = _info_of(info, index)
        if self._mask is None:
            return told
        part = shown if self._mask.part == "obs" else info
        return {**told, keys.ACTION_MASK: part[self._mask.name][index]}


def _row(batch: Any, index: int, space: gymnasium.Space | None) -> Any:
    """One world's part of observations; a tuple holds worlds unless the ``space`` of one world is a ``Tuple``."""
    if isinstance(batch, Mapping):
        of = space.spaces if isinstance(space, spaces.Dict) else {}
        return {key: _row(part, index, of.get(key)) for key, part in batch.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_row(part, index, each) for part, each in zip(batch, space.spaces, strict=True))
    return batch[index]


def _info_of(info: Mapping[str, Any], index: int) -> dict[str, Any]:
    """One world's part of a vector's ``info``: entries that it has itself, as ``_name`` tells."""
    return {
        name: _info_of(value, index) if isinstance(value, Mapping) else value[index]
        for name, value in info.items()
        if not name.startswith("_") and _has(info, name, index)
    }


def _has(info: Mapping[str, Any], name: str, index: int) -> bool:
    has = info.get(f"_{name}")
    return bool(has[index]) if has is not None else np.ndim(info[name]) > 0 or isinstance(info[name], Mapping)


def _stacked(rows: Sequence[Entries]) -> Entries:
    """Entries of all worlds; those of worlds that have not begun are zeros."""
    begun = next(row for row in rows if row)
    empty = {key: np.zeros_like(value) for key, value in begun.items()}
    return {key: np.stack([(row or empty)[key] for row in rows]) for key in begun}
