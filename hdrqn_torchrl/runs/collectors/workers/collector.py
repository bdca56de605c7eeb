"""One batch of all workers' worlds after the other, each world in its own row, whatever happens to the workers."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.runs.collectors.workers.handles import PlaceLost, WorkerHandle, WorkerLost, WorkerPlace
from hdrqn_torchrl.runs.collectors.workers.packing import pack, unpack
from hdrqn_torchrl.runs.collectors.workers.worker import Delivery

_MOST_FAILURES = 3


class WorkersCollector:
    """Collects in rounds: each worker delivers one batch ``[n, T]``, and their worlds are the rows of one ``[N, T]``.

    So a world has the same row for ever. Memories, options, episodes and recurrent states are then what they are with
    one collector, and nothing of one world can end in another. A worker that ends or hangs is replaced; its episodes
    in progress are lost, new ones begin in its rows, and memories know the gap by the episodes' numbers.

    TorchRL's ``MultiSyncCollector``, ``MultiAsyncCollector`` and ``RayCollector`` are not used: their batches do not
    say whose they are, they have no state to go on from, and they end with the first worker that does.

    Args:
        place: where workers run.
        env: transformed environment of all N worlds, which is not stepped: its specs check what is loaded.
        policy: whose weights the workers are sent.
        workers: W; each has N / W worlds.
        total_frames: environment frames to collect.
        sync: workers wait for new weights; ``False``: they collect the next batch while the learner learns from the
            last one, with weights that are one round old. They are never further ahead.
        seed: of worker 0; the others' come from it.
        updates: number of gradient steps so far, by which the age of weights is told.
        patience_seconds: a worker that does not answer for so long is replaced.

    Raises:
        ValueError: if an argument breaks its rule.
        WorkerError: while collecting, if a worker's own code fails.
        WorkerLost: likewise, if a worker is lost three times in a row without a batch between, or all are and can't be
            replaced (``PlaceLost``). After :meth:`give_up` the state can be saved all the same.
    """

    def __init__(
        self,
        place: WorkerPlace,
        env: EnvBase,
        policy: TensorDictModuleBase,
        *,
        workers: int,
        total_frames: int,
        sync: bool = True,
        seed: int = 0,
        updates: Callable[[], int] = lambda: 0,
        patience_seconds: float = 300.0,
    ) -> None:
        check_workers(workers, env.batch_size[0])
        if not patience_seconds > 0:
            raise ValueError(f"patience_seconds must be > 0, got {patience_seconds}; use 300.")
        self.place, self.env, self.policy, self.sync = place, env, policy, sync
        self.total_frames, self.seed = total_frames, seed
        self.updates, self.patience_seconds = updates, patience_seconds
        self.frames = 0
        self.worlds = env.batch_size[0] // workers
        """Of each worker."""
        self._starts = [0] * workers  # times that each was started, which changes its seed
        self._first_ids = [0] * workers  # what is added to its numbers of episodes
        self._next_ids = [0] * workers
        self._failures = [0] * workers  # since its last answer
        self._workers: list[WorkerHandle] = []
        self._round = 0  # frames of all workers' batches together; 0: not known yet
        self._ordered = self._is_new = self._has_given_up = False
        self._version = 0  # updates of the weights that were sent last
        self._ready: TensorDictBase | None = None
        self.lost_workers = self.lost_episodes = 0
        self._ages: list[int] = []

    def __iter__(self) -> Iterator[TensorDictBase]:
        while self.frames < self.total_frames:
            batch = self._collected()
            self.frames += batch.numel()
            if not self.sync and not self._ordered and self.frames < self.total_frames:
                self._order()
            yield batch

    def update_policy_weights_(self) -> None:
        """The workers get the policy's weights with their next order."""
        self._is_new = True

    def _collected(self) -> TensorDictBase:
        """The next round."""
        if self._ready is not None:
            batch, self._ready = self._ready, None
            return batch
        if not self._ordered:
            self._order()
        return self._gather(and_order=not self.sync and 0 < self._round < self.total_frames - self.frames)

    def _start(self) -> None:
        if not self._workers:
            self._workers = [self.place.start(index, seed=self._seed_of(index)) for index in range(len(self._starts))]
            self._is_new = True

    def _seed_of(self, index: int) -> int:
        """Another one each time that a worker is started."""
        place = (index, self._starts[index])
        self._starts[index] += 1
        return self.seed if place == (0, 0) else int(np.random.SeedSequence([self.seed, *place]).generate_state(1)[0])

    def _order(self) -> None:
        """Asks all workers for a batch."""
        self._start()
        order = self._next_order()
        for index in range(len(self._workers)):
            self._send(index, "collect", *order)
        self._ordered = True

    def _next_order(self) -> tuple[Any, Tensor | None]:
        """What all workers are sent: weights, if they are new, and random numbers."""
        weights = self._shared_weights() if self._is_new else None
        self._is_new, self._version = False, self.updates()
        return weights, self._stream()

    def _shared_weights(self) -> Any:
        return self.place.share(pack({name: value.detach().cpu() for name, value in self.policy.state_dict().items()}))

    def _stream(self) -> Tensor | None:
        """One worker that is waited for draws from the learner's random numbers: it is then no other than none."""
        return torch.get_rng_state() if self.sync and len(self._starts) == 1 else None

    def _gather(self, *, and_order: bool = False) -> TensorDictBase:
        """One batch of all workers.

        Args:
            and_order: each is asked for the next one as soon as it has delivered, before anything is unpacked.
        """
        self._ages.append(self.updates() - self._version)
        order = self._next_order() if and_order else None
        received: list[tuple[Delivery, int]] = []
        for index in range(len(self._workers)):
            delivery: Delivery = self._receive(index, "collect", None, self._stream())
            first = self._first_ids[index]
            self._next_ids[index] = max(self._next_ids[index], first + delivery.last_id + self.worlds)
            received.append((delivery, first))
            if order is not None:
                self._send(index, "collect", *order)
        self._ordered = and_order
        if (stream := received[0][0].stream) is not None:
            torch.set_rng_state(stream)
        batches = [self._numbered(index, unpack(each.batch), first) for index, (each, first) in enumerate(received)]
        self._round = sum(batch.numel() for batch in batches)
        return batches[0] if len(batches) == 1 else torch.cat(batches, 0)  # type: ignore[return-value]

    def _numbered(self, index: int, batch: TensorDictBase, first: int) -> TensorDictBase:
        """The batch with numbers of episodes that no other worker has, nor this one before it was replaced."""
        return batch.set(keys.TRAJ_IDS, (batch.get(keys.TRAJ_IDS) + first) * len(self._workers) + index)

    def _send(self, index: int, method: str, *args: Any) -> None:
        while True:
            try:
                return self._workers[index].send(method, *args)
            except PlaceLost:
                raise
            except WorkerLost as reason:
                self._replace(index, reason)
                args = self._afresh(method, args)

    def _receive(self, index: int, method: str, *args: Any) -> Any:
        """The answer to a call; of a worker that is lost, that of its successor to the same call."""
        while True:
            try:
                answer = self._workers[index].receive(self.patience_seconds)
            except PlaceLost:
                raise
            except WorkerLost as reason:
                self._replace(index, reason)
                self._send(index, method, *self._afresh(method, args))
            else:
                self._failures[index] = 0
                return answer

    def _afresh(self, method: str, args: tuple[Any, ...]) -> tuple[Any, ...]:
        """Arguments of a call for a worker that has no weights yet."""
        return (self._shared_weights(), *args[1:]) if method == "collect" else args

    def _replace(self, index: int, reason: WorkerLost) -> None:
        """Another worker with new episodes in the same rows."""
        self._failures[index] += 1
        if self._failures[index] >= _MOST_FAILURES:
            raise WorkerLost(
                f"worker {index} {reason}, {_MOST_FAILURES} times in a row; look for what ends it (memory?), or raise "
                "collector.patience_seconds"
            ) from reason
        print(f"worker {index} {reason}; it is replaced, and new episodes begin", file=sys.stderr, flush=True)
        self._workers[index].stop()
        self._count_lost(index)
        self._workers[index] = self.place.start(index, seed=self._seed_of(index))

    def _count_lost(self, index: int) -> None:
        self.lost_workers += 1
        self.lost_episodes += self.worlds
        self._first_ids[index] = self._next_ids[index]

    def give_up(self, frames: int) -> None:
        """Counts all workers as lost. They are asked nothing any more, and others begin where this state is loaded.

        Args:
            frames: of the batches that count.
        """
        self.frames, self._ready = frames, None
        if not self._has_given_up:
            self._has_given_up, self._ordered = True, False
            for index in range(len(self._starts)):
                self._count_lost(index)

    def metrics(self) -> dict[str, float]:
        """Workers and episodes lost so far; age of weights, in updates, in the batches since :meth:`clear`."""
        ages = self._ages or [0]
        return {
            "collector/lost_workers": self.lost_workers,
            "collector/lost_episodes": self.lost_episodes,
            "collector/weights_age": sum(ages) / len(ages),
            "collector/weights_age_max": max(ages),
        }

    def clear(self) -> None:
        """A new row begins."""
        self._ages = []

    def state_dict(self) -> dict[str, Any]:
        """All workers' states; what has been ordered is collected first, and is part of it."""
        if self._ordered:
            self._ready = self._gather()
        if not self._has_given_up:
            self._start()
        # First: one that is found dead now is replaced, which changes what is counted.
        workers = [None] * len(self._starts) if self._has_given_up else self._ask_all("state_dict")
        return {
            "frames": self.frames,
            "ready": self._ready,
            "starts": list(self._starts),
            "first_ids": list(self._first_ids),
            "next_ids": list(self._next_ids),
            "lost_workers": self.lost_workers,
            "lost_episodes": self.lost_episodes,
            "ages": list(self._ages),
            "workers": workers,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned.

        Raises:
            ValueError: if it is that of another number of workers.
        """
        stored = state.get("workers")
        if stored is None or len(stored) != len(self._starts):
            found = "a collector without workers" if stored is None else f"{len(stored)} workers"
            raise ValueError(f"collector.workers must be as before, got {len(self._starts)} for the state of {found}.")
        if None not in stored:
            self._start()
            self._ask_all("load_state_dict", [(each,) for each in stored])
        self.frames, self._ready, self._ordered, self._is_new = state["frames"], state["ready"], False, True
        self._starts, self._ages = list(state["starts"]), list(state["ages"])
        self._first_ids, self._next_ids = list(state["first_ids"]), list(state["next_ids"])
        self.lost_workers, self.lost_episodes = state["lost_workers"], state["lost_episodes"]

    def _ask_all(self, method: str, arguments: Sequence[tuple[Any, ...]] = ()) -> list[Any]:
        """Their answers to a call with arguments for each of them."""
        arguments = arguments or [()] * len(self._workers)
        for index, args in enumerate(arguments):
            self._send(index, method, *args)
        return [self._receive(index, method, *args) for index, args in enumerate(arguments)]

    def shutdown(self) -> None:
        """Ends all workers; safe to call twice."""
        for worker in self._workers:
            worker.stop()
        self._workers, self._ordered = [], False
        self.place.close()


def check_workers(workers: int, worlds: int) -> None:
    """Refuses a number of workers among which the worlds can't be divided.

    Raises:
        ValueError: likewise.
    """
    if workers < 1 or worlds % workers:
        raise ValueError(
            f"workers must divide num_envs={worlds}, got {workers}; each has the same number of worlds: change either."
        )
