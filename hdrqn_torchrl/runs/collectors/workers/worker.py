"""What a worker does, wherever it runs: it collects in worlds of its own with weights that it is sent."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.modules import EpsilonGreedy
from hdrqn_torchrl.random_numbers import seed_all
from hdrqn_torchrl.runs.collectors.resumable import ResumableCollector
from hdrqn_torchrl.runs.collectors.workers.packing import pack, unpack
from hdrqn_torchrl.runs.persistence.checkpoint import RandomState


class MakeWorker(Protocol):
    """Makes a worker's part; it has to be picklable."""

    def __call__(self, index: int, seed: int) -> tuple[EnvBase, TensorDictModuleBase]:
        """The transformed environment of a worker ``[n]``, seeded, and a policy whose weights don't matter."""


class Delivery(NamedTuple):
    """What a worker sends for each order."""

    batch: bytes
    """``[n, T]``, packed"""
    last_id: int
    """The highest number of an episode in it."""
    stream: Tensor | None
    """The random numbers that follow, if the order came with some."""


class Worker:
    """One collector.

    Args:
        make: makes its part.
        index: its number.
        seed: of its worlds and its choices.
        steps: T, steps of each world in a batch.
        all_worlds: number of all workers' worlds, over which a ladder of epsilons reaches; ``None``: it is alone.
        threads: of torch; ``None``: as they are.

    Examples:
        >>> from hdrqn_torchrl.algorithms import make_drqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> def make(index, seed):
        ...     env = MultiGoalGridEnv(num_envs=2, seed=seed)
        ...     agent = make_drqn(env, compact_network())
        ...     return agent.transform(env), agent.policy
        >>> unpack(Worker(make, 0, seed=0, steps=3).collect(None).batch).shape
        torch.Size([2, 3])
    """

    def __init__(
        self,
        make: MakeWorker,
        index: int,
        *,
        seed: int,
        steps: int,
        all_worlds: int | None = None,
        threads: int | None = None,
    ) -> None:
        if threads is not None:
            torch.set_num_threads(threads)
        seed_all(seed)
        env, self.policy = make(index, seed)
        worlds = env.batch_size[0]
        for module in self.policy.modules():
            if isinstance(module, EpsilonGreedy) and all_worlds is not None:
                module.rungs = index * worlds, all_worlds
        self.collector = ResumableCollector(
            env,
            self.policy,
            frames_per_batch=worlds * steps,
            total_frames=-1,
            auto_register_policy_transforms=False,
        )
        self._batches = iter(self.collector)

    def collect(self, weights: bytes | None, stream: Tensor | None = None) -> Delivery:
        """The next batch.

        Args:
            weights: packed state of the policy; ``None``: as before.
            stream: state of torch's random generator, which goes on where someone else's stands; ``None``: its own.
        """
        if weights is not None:
            self.policy.load_state_dict(unpack(weights))
        if stream is not None:
            torch.set_rng_state(stream)
        batch = next(self._batches)
        last_id = int(batch.get(keys.TRAJ_IDS).max())
        return Delivery(pack(batch), last_id, None if stream is None else torch.get_rng_state())

    def state_dict(self) -> dict[str, Any]:
        """Its worlds, options and recurrent states, and its random numbers."""
        return {"collector": self.collector.state_dict(), "random": RandomState().state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self.collector.load_state_dict(state["collector"])
        RandomState().load_state_dict(state["random"])
