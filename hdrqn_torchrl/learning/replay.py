"""What a learner stores, and the minibatches that it draws from that."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, Protocol

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import unravel_key
from torchrl.objectives import LossModule

from hdrqn_torchrl import keys
from hdrqn_torchrl.data import FROM_STARTS, LongerEpisodes, make_sequence_buffer, sample_sequences
from hdrqn_torchrl.data.device_draws import DeviceDraws
from hdrqn_torchrl.learning.settings import LearnerSettings


class Extract(Protocol):
    """Turns a collected batch ``[N, T]`` into what is stored, ``None`` if there is nothing yet."""

    def __call__(self, batch: TensorDictBase) -> TensorDictBase | None: ...

    def reset(self) -> None:
        """Forgets what it carries from batch to batch."""

    def state_dict(self) -> dict[str, Any]:
        """What it carries from batch to batch."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what ``state_dict`` returned."""


class Replay:
    """The replay memory of a learner, and the minibatches drawn from it.

    Several minibatches are drawn at once and handed out one by one, until something new is stored.

    Args:
        settings: of the learner.
        loss: says how long sequences are, and what ends them.
        num_envs, episode_len, samples_per_draw: as of :class:`~hdrqn_torchrl.learning.Learner`.
        refresh: changes each minibatch as it is drawn; ``None``: nothing is changed.
        on_device: whether minibatches are drawn by the device, inside what is captured (:meth:`draw`).
        device: where it lies.

    Raises:
        ValueError: if a setting breaks its rule.

    Examples:
        See :class:`~hdrqn_torchrl.learning.Learner`, whose ``replay`` it is.
    """

    def __init__(
        self,
        settings: LearnerSettings,
        loss: LossModule,
        *,
        num_envs: int | None,
        episode_len: int | None,
        samples_per_draw: int,
        refresh: Callable[[TensorDictBase], TensorDictBase] | None,
        on_device: bool,
        device: torch.device,
    ) -> None:
        if settings.slice_len is None:
            raise ValueError("slice_len must be a number, got None; only v3 asks the task how long an episode is.")
        lookahead: int = getattr(loss, "lookahead", 0)
        done_key, terminated_key = _ends(loss, rows=num_envs is None)
        self.settings, self.refresh, self.sequence_len = settings, refresh, settings.slice_len + lookahead
        self.buffer = make_sequence_buffer(
            settings.capacity,
            slice_len=settings.slice_len,
            lookahead=lookahead,
            batch_size=settings.batch_size * samples_per_draw,
            num_envs=num_envs,
            episode_len=episode_len,
            sampling=settings.sampling,
            priority_exponent=settings.priority_exponent,
            importance_exponent=settings.importance_exponent,
            done_key=unravel_key(("next", done_key)),
            terminated_key=None if terminated_key is None else unravel_key(("next", terminated_key)),
            device=device,
        )
        self.draws: DeviceDraws | None = None
        """What draws on the device."""
        if on_device:
            self.draws = DeviceDraws(self.buffer, sequences=settings.batch_size, length=self.sequence_len)
        self._longer: LongerEpisodes | None = None
        if settings.sampling in FROM_STARTS and (episode_len is None or episode_len > settings.slice_len):
            self._longer = LongerEpisodes(
                settings.slice_len, done_key=done_key, terminated_key=terminated_key or keys.TERMINATED
            )
        self._drawn: list[TensorDictBase] = []
        self._has_warned = self._could_draw = False

    def store(self, transitions: TensorDictBase | None) -> None:
        """Stores transitions; minibatches drawn before are drawn anew.

        Args:
            transitions: ``[N, T]`` (steps) or ``[M]`` (options); ``None``: there were none in a batch.
        """
        self._drawn = []
        if transitions is not None:
            self.buffer.extend(transitions)
            self._warn_of_longer(transitions)

    def can_draw(self) -> bool:
        """Whether the memory holds a sequence; warns once where it is full of others."""
        if self._could_draw and self.draws is not None and self.buffer.keeps_starts:
            return True  # without asking the device
        self._could_draw = self.buffer.can_sample()
        if not self._could_draw and self.buffer.is_full():
            self._warn_of_none()
        return self._could_draw

    def sample(self) -> TensorDictBase:
        """One minibatch of sequences ``[batch_size, slice_len + lookahead]``."""
        if not self._drawn:
            self._drawn = list(sample_sequences(self.buffer).split(self.settings.batch_size, 0))
        return self._refreshed(self._drawn.pop())

    def draw(self) -> TensorDictBase:
        """The same, drawn by the device; part of what is captured."""
        assert self.draws is not None
        return self._refreshed(self.draws.draw())

    def _refreshed(self, sample: TensorDictBase) -> TensorDictBase:
        return sample if self.refresh is None else self.refresh(sample)

    def rewrite(self, change: Callable[..., None]) -> None:
        """Changes what is stored; minibatches drawn before are drawn anew.

        Args:
            change: as of :meth:`~hdrqn_torchrl.data.SequenceBuffer.rewrite`.
        """
        self.buffer.rewrite(change)
        self._drawn = []

    def empty(self) -> None:
        """Forgets all that is stored."""
        if len(self.buffer):
            self.buffer.empty()
        self._drawn, self._could_draw = [], False

    def state_dict(self) -> dict[str, Any]:
        """What is stored, and the minibatches that are left of those drawn."""
        return {"buffer": self.buffer.state_dict(), "drawn": self._drawn}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self.buffer.load_state_dict(state["buffer"])
        self._drawn, self._could_draw = list(state["drawn"]), False

    def _warn_of_longer(self, transitions: TensorDictBase) -> None:
        """Once, if an episode has transitions that no sequence from its start will ever show."""
        if self._longer is None or not self._longer.seen(transitions):
            return
        self._longer = None
        warnings.warn(
            f"slice_len should cover an episode with sampling={self.settings.sampling!r}, got "
            f"{self.settings.slice_len} where one has more transitions; the later ones are never learned from: raise "
            "slice_len, or use sampling='steps' with stored_state=True.",
            stacklevel=5,
        )

    def _warn_of_none(self) -> None:
        """Once: the memory is full, and holds no sequence that could be drawn."""
        if self._has_warned:
            return
        self._has_warned = True
        warnings.warn(
            f"capacity should be so large that a sequence of {self.sequence_len} transitions that begins where an "
            f"episode does is always stored, got {self.settings.capacity}; nothing is learned while there is none: "
            "raise it, use a smaller slice_len, or stored_state=True with sampling='steps'.",
            stacklevel=5,
        )


def warn_old_memory() -> None:
    """A stored memory can't be used."""
    warnings.warn(
        "the stored replay memory is of an earlier version, which kept each observation twice; it begins empty "
        "and is warmed up again, so that the training goes on, but not bit for bit as it would have.",
        stacklevel=4,
    )


def _ends(loss: LossModule, *, rows: bool) -> tuple[NestedKey, NestedKey | None]:
    """Under ``"next"``: end of an episode; without which flag its last transition has no target, if that may be so.

    Rows end as the loss has it: with the episode, or with the option of the level above.
    """
    lookahead: int = getattr(loss, "lookahead", 0)
    if rows and lookahead:
        return loss.tensor_keys.done, loss.tensor_keys.terminated
    return keys.DONE, None
