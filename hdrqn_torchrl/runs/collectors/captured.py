"""A collector whose batches are one captured graph each.

TorchRL's ``Collector`` can't be captured: after every step it asks the device whether an episode has ended, and its
resets read values, too. Here worlds whose episode has ended are chosen by masks. Untested on a GPU (docs/gpu.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.envs import EnvBase, InitTracker, TensorDictPrimer, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hdrqn_torchrl import keys
from hdrqn_torchrl.learning.captured import CudaRecording, Recording, Replayed
from hdrqn_torchrl.runs.collectors.resumable import has_given_up, new_seed
from hdrqn_torchrl.transforms import SubgoalTransform

_KNOWN = (InitTracker, TensorDictPrimer, SubgoalTransform)
"""Transforms that are tensor programs, apart from a primer's reset, which gives the same values every time."""


class CapturedCollector:
    """Collects batches ``[N, T]`` as TorchRL's ``Collector`` does, from worlds that are tensor programs.

    Args:
        env: the worlds with their transforms (:func:`can_capture`). Its base keeps what goes on from step to step in
            ``worlds``, and what it draws from in ``generators``.
        policy: acts in it, with the parameters that are trained.
        frames_per_batch: N times T.
        total_frames: where it ends; -1: never.
        recording: makes a recording that knows the generators.
        warm_ups: batches before the recording.
    """

    def __init__(
        self,
        env: TransformedEnv,
        policy: TensorDictModuleBase,
        *,
        frames_per_batch: int,
        total_frames: int = -1,
        recording: Callable[[Sequence[torch.Generator]], Recording] = CudaRecording,
        warm_ups: int = 2,
    ) -> None:
        self.env, self.policy, self.total_frames = env, policy, total_frames
        self.frames_per_batch, self.steps = frames_per_batch, frames_per_batch // env.batch_size[0]
        self._frames, self._batches, self._has_given_up = 0, 0, False
        self._replayed = Replayed(recording(env.base_env.generators), warm_ups)
        self._start = env.reset()  # what primers set
        number = torch.arange(env.batch_size[0], device=self._start.device)
        self._root = self._start.clone().set(keys.TRAJ_IDS, number)
        self._next_episode = torch.full_like(number[0], len(number))
        self._worlds = {name: value.clone() for name, value in env.base_env.worlds.items()}
        env.base_env.worlds = self._worlds

    def __iter__(self) -> Iterator[TensorDictBase]:
        while self.total_frames < 0 or self._frames < self.total_frames:
            yield self._collect()

    def give_up(self, frames: int) -> None:
        """As that of :class:`~hdrqn_torchrl.runs.collectors.resumable.ResumableCollector`."""
        self._frames, self._has_given_up = frames, True

    def _begin_anew(self) -> None:
        self.env.set_seed(new_seed())
        fresh, number = self.env.reset(), torch.arange(self.env.batch_size[0], device=self._root.device)
        fresh.set(keys.TRAJ_IDS, self._next_episode + number)
        for key, value in self._root.items(True, True):
            value.copy_(fresh.get(key))
        self._next_episode += len(number)
        self._keep_worlds()
        self._has_given_up = False

    def _keep_worlds(self) -> None:
        """What recordings read stays where it is."""
        for name, value in self.env.base_env.worlds.items():
            self._worlds[name].copy_(value)
        self.env.base_env.worlds = self._worlds

    def _collect(self) -> TensorDictBase:
        if self._has_given_up:
            self._begin_anew()
        batch = TensorDict({}, (self.env.batch_size[0], self.steps), device=self.env.device)
        for key, value in self._replayed(self._rollout).items():
            batch.set(key, value)
        self._frames += self.frames_per_batch
        self._batches += 1
        return batch

    @torch.no_grad()
    def _rollout(self) -> dict[Any, Tensor]:
        """T steps from where the last ones ended; the host reads nothing, and what goes on stays where it is."""
        root, steps, following = self._root.copy(), [], self._next_episode
        with set_exploration_type(ExplorationType.RANDOM):
            for _ in range(self.steps):
                step = self.env.step(self.policy(root))
                steps.append(step)
                root, following = self._follow(step, following)
        batch = TensorDict.stack(steps, 1)
        for key in self._root.keys(True, True):
            self._root.get(key).copy_(root.get(key))
        for name, value in self.env.base_env.worlds.items():
            self._worlds[name].copy_(value)
        self._next_episode.copy_(following)
        self.env.base_env.worlds = self._worlds
        return dict(batch.items(True, True))

    def _follow(self, step: TensorDictBase, following: Tensor) -> tuple[TensorDictBase, Tensor]:
        """The next step's root, where ended episodes have begun anew, and the number of the next episode."""
        root = self.env.step_mdp(step)
        ended = root.get(keys.DONE)
        fresh = self._reset(root.copy().set("_reset", ended))
        for key, value in fresh.items(True, True):
            root.set(key, torch.where(expand_as_right(ended.squeeze(-1), value), value, root.get(key)))
        begun = ended.squeeze(-1)
        numbers = torch.where(begun, following + begun.cumsum(0) - 1, step.get(keys.TRAJ_IDS))
        root = root.select(*self._root.keys(True, True), strict=False).set(keys.TRAJ_IDS, numbers)
        return root, following + begun.sum()

    def _reset(self, root: TensorDictBase) -> TensorDictBase:
        fresh = self.env.base_env._reset(root)
        for transform in _transforms(self.env):
            if isinstance(transform, TensorDictPrimer):
                for key in transform.primers.keys(True, True):
                    fresh.set(key, self._start.get(key))
            else:
                fresh = transform._reset(root, fresh)
        return fresh

    def update_policy_weights_(self) -> None:
        """The policy acts with the very parameters that are trained: nothing to do."""

    def shutdown(self) -> None:
        """Nothing runs beside it."""

    def state_dict(self) -> dict[str, Any]:
        """As that of :class:`~hdrqn_torchrl.runs.ResumableCollector`; each can load the other's."""
        state = {
            "env_state_dict": self.env.state_dict(),
            "frames": self._frames,
            "iter": self._batches - 1,
            "traj_pool": {"traj_id": self._next_episode.to("cpu", torch.int32, copy=True)},
        }
        if self._has_given_up:
            return state
        worlds = {name: value.clone() for name, value in self.env.base_env.state_dict().items()}  # replays change them
        return state | {"base_env": worlds, "carrier": self._root.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned.

        Raises:
            ValueError: if it is that of other worlds, or of workers.
        """
        if "workers" in state:
            raise ValueError(f"collector must be one with {len(state['workers'])} workers, as before, got local.")
        self.env.load_state_dict(state["env_state_dict"], strict=False)
        self._frames, self._batches = state["frames"], state["iter"] + 1
        self._next_episode.copy_(state["traj_pool"]["traj_id"])
        self._has_given_up = has_given_up(state)
        if self._has_given_up:
            return
        self.env.base_env.load_state_dict(state["base_env"])
        self._keep_worlds()
        for key, value in self._root.items(True, True):
            value.copy_(state["carrier"].get(key))


def can_capture(env: EnvBase) -> bool:
    """Whether acting in ``env`` is a tensor program as far as is known: its worlds, and all transforms."""
    return (
        isinstance(env, TransformedEnv)
        and hasattr(env.base_env, "worlds")
        and all(isinstance(each, _KNOWN) for each in _transforms(env))
    )


def _transforms(env: TransformedEnv) -> list[Any]:
    """All transforms, the nested ones, too, in the order in which they work."""
    found, waiting = [], [env.transform]
    while waiting:
        each = waiting.pop(0)
        if hasattr(each, "transforms"):
            waiting = [*each.transforms, *waiting]
        else:
            found.append(each)
    return found
