"""The replay memory that a learner's settings and loss require."""

from __future__ import annotations

import warnings
from typing import Any, Protocol

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import unravel_key
from torchrl.objectives import LossModule

from hdrqn_torchrl import keys
from hdrqn_torchrl.data import FROM_STARTS, LongerEpisodes, SequenceBuffer, make_sequence_buffer
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


def make_memory(
    settings: LearnerSettings,
    loss: LossModule,
    *,
    num_envs: int | None,
    episode_len: int | None,
    samples_per_draw: int,
    device: torch.device,
) -> SequenceBuffer:
    """The memory of a learner; its arguments are those of :class:`~hdrqn_torchrl.learning.Learner`.

    Raises:
        ValueError: if a setting breaks its rule.
    """
    if settings.slice_len is None:
        raise ValueError("slice_len must be a number, got None; only v3 asks the task how long an episode is.")
    done_key, terminated_key = _ends(loss, rows=num_envs is None)
    return make_sequence_buffer(
        settings.capacity,
        slice_len=settings.slice_len,
        lookahead=getattr(loss, "lookahead", 0),
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


def make_longer_episodes(
    settings: LearnerSettings, loss: LossModule, *, num_envs: int | None, episode_len: int | None
) -> LongerEpisodes | None:
    """What looks out for transitions that no sequence will ever show; ``None`` where there can be none."""
    assert settings.slice_len is not None
    if settings.sampling not in FROM_STARTS or (episode_len is not None and episode_len <= settings.slice_len):
        return None
    done_key, terminated_key = _ends(loss, rows=num_envs is None)
    return LongerEpisodes(settings.slice_len, done_key=done_key, terminated_key=terminated_key or keys.TERMINATED)


def warn_of_longer(
    longer: LongerEpisodes | None, transitions: TensorDictBase, settings: LearnerSettings
) -> LongerEpisodes | None:
    """Warns once that an episode has transitions that no sequence from its start will ever show.

    Returns:
        What goes on looking; ``None`` once it has warned.
    """
    if longer is None or not longer.seen(transitions):
        return longer
    warnings.warn(
        f"slice_len should cover an episode with sampling={settings.sampling!r}, got {settings.slice_len} where one "
        "has more transitions; the later ones are never learned from: raise slice_len, or use sampling='steps' with "
        "stored_state=True.",
        stacklevel=4,
    )
    return None


def warn_incomplete(settings: LearnerSettings, length: int) -> None:
    """A memory is full, and holds no sequence of ``length`` transitions that could be drawn."""
    warnings.warn(
        f"capacity should be so large that a sequence of {length} transitions that begins where an episode does is "
        f"always stored, got {settings.capacity}; nothing is learned while there is none: raise it, use a smaller "
        "slice_len, or stored_state=True with sampling='steps'.",
        stacklevel=4,
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
