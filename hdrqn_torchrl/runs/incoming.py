"""What the host learns of collected batches: whether they are sound, and which episodes ended."""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.devices import Arriving, LateCheck, on_host
from hdrqn_torchrl.learning.finite import check_batch
from hdrqn_torchrl.runs.episode_tracker import EpisodeTracker


class Incoming:
    """Asks about batches ``[N, T]``: of those on the host at once, of those on a GPU when the next one is there.

    To ask a GPU is to wait for all that it has just begun. How many episodes have ended is such a question, too; so
    the sums of all steps are copied, and those that count are chosen once they have arrived.

    Args:
        tracker: sums up what happens in episodes.

    Examples:
        >>> Incoming(EpisodeTracker()).settle()
        []
    """

    def __init__(self, tracker: EpisodeTracker) -> None:
        self.tracker = tracker
        self._check = LateCheck()
        self._arriving: tuple[Arriving, dict[str, Arriving]] | None = None

    def check(self, batch: TensorDictBase, frames: int) -> None:
        """Refuses a batch on the host that is not finite; it counts as not collected.

        Raises:
            NonFiniteError: see :func:`~hdrqn_torchrl.learning.finite.check_batch`.
        """
        if on_host(batch.get(("next", keys.DONE))):
            check_batch(batch, frames)

    def check_late(self, batch: TensorDictBase, frames: int) -> None:
        """The same for a batch on a GPU, which is stored by the time of the answer: nothing must be saved then."""
        if not on_host(batch.get(("next", keys.DONE))):
            check_batch(batch, frames, self._check)

    def take(self, batch: TensorDictBase) -> list[TensorDictBase]:
        """Takes a batch; returns episodes ``[M]`` that are known by now."""
        sums, ended = self.tracker.follow(batch)
        if on_host(ended):
            return [sums[ended]]
        known = self._arrived()
        self._arriving = Arriving(ended), {name: Arriving(value) for name, value in sums.items()}
        return known

    def settle(self) -> list[TensorDictBase]:
        """Waits for all that is on its way; returns the episodes.

        Raises:
            NonFiniteError: if the last batch was not finite.
        """
        self._check.settle()
        return self._arrived()

    def _arrived(self) -> list[TensorDictBase]:
        if self._arriving is None:
            return []
        (ended, sums), self._arriving = self._arriving, None
        chosen = ended.get()
        return [TensorDict({name: value.get() for name, value in sums.items()}, chosen.shape)[chosen]]
