"""A batch of Gymnasium worlds as a TorchRL environment with the project's entries."""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Categorical, Composite
from torchrl.envs import EnvBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.devices import to_device
from hdrqn_torchrl.envs.gym.vectors import Worlds
from hdrqn_torchrl.envs.gym.worlds import Entries, Reading
from hdrqn_torchrl.envs.specs import episode_ends, flags, rewards
from hdrqn_torchrl.envs.task import Task


class GymTaskEnv(EnvBase):
    """N worlds of a Gymnasium environment; :func:`~hdrqn_torchrl.envs.make_gym` makes them.

    TorchRL's ``GymWrapper`` keeps no state for a resumed run, reads arrays only from ``info`` and leaves subgoals out,
    hence this class.

    Args:
        worlds: they.
        num_envs: N.
        actions: the environment's numbers of the actions that agents have.
        reading: how their entries are read.
        task: what is known about the task.
        render: returns a picture of the first world.
        seed: of all episodes; ``None`` draws one from torch's global generator.
        device: device of all tensors.
    """

    batch_locked = True

    def __init__(
        self,
        worlds: Worlds,
        *,
        num_envs: int,
        actions: Sequence[int],
        reading: Reading,
        task: Task,
        render: Callable[[], Any] | None = None,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(device=torch.device(device or "cpu"), batch_size=(num_envs,))
        self.worlds, self.task, self._render = worlds, task, render
        self._actions, self._reading = np.array(actions, np.int64), reading
        sizes = {key: space.shape[0] for key, space in reading.space.items() if key != keys.OBSERVATION and space.shape}
        self.observation_spec = Composite(
            {
                keys.OBSERVATION: reading.encoder.spec(num_envs, device=self.device),
                **{key: flags(num_envs, size, device=self.device) for key, size in sizes.items()},
            },
            shape=(num_envs,),
            device=self.device,
        )
        self.action_spec = Categorical(len(actions), shape=(num_envs,), dtype=torch.int64, device=self.device)
        self.reward_spec = rewards(num_envs, device=self.device)
        self.done_spec = episode_ends(num_envs, device=self.device)
        self._entries: Entries = {}
        self._lost = False  # whether a restart could not bring back the episodes in progress
        self.set_seed(torch.randint(2**31, ()).item() if seed is None else seed)

    def _set_seed(self, seed: int | None) -> None:
        self.worlds.seed(seed or 0)
        self._entries = {}

    def _reset(self, tensordict: TensorDictBase | None, **kwargs) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        chosen = np.ones(self.num_worlds, np.bool_) if mask is None else mask.view(-1).cpu().numpy()
        chosen = chosen if self._entries else np.ones_like(chosen)  # after a new seed all begin
        begun = self.worlds.reset(chosen)
        self._reading.encoder.check_finite(begun[keys.OBSERVATION])
        if not self._entries:
            self._entries = {key: value.copy() for key, value in begun.items()}
        for key, value in self._entries.items():
            value[chosen] = begun[key][chosen]
        self._forget_outcome()
        self._lost = False
        no = np.zeros(self.num_worlds, np.bool_)
        return self._tensordict({**self._entries, keys.DONE: no, keys.TERMINATED: no, keys.TRUNCATED: no})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._lost:
            return self._cut_off()
        outcome = self.worlds.step(self._actions[tensordict.get(keys.ACTION).cpu().numpy()])
        self._reading.encoder.check_finite(outcome.entries[keys.OBSERVATION])
        self._entries = {key: np.array(value) for key, value in outcome.entries.items()}
        return self._tensordict(
            {
                **self._entries,
                keys.REWARD: outcome.reward,
                keys.EXTRINSIC_REWARD: outcome.reward,
                keys.DONE: outcome.terminated | outcome.truncated,
                keys.TERMINATED: outcome.terminated,
                keys.TRUNCATED: outcome.truncated,
            }
        )

    def _cut_off(self) -> TensorDictBase:
        """A step in which nothing happens but the end, as by a time limit, of episodes that are lost."""
        no, nothing = np.zeros(self.num_worlds, np.bool_), np.zeros(self.num_worlds, np.float32)
        yes = ~no
        self._forget_outcome()
        ends = {keys.DONE: yes, keys.TERMINATED: no, keys.TRUNCATED: yes}
        return self._tensordict({**self._entries, keys.REWARD: nothing, keys.EXTRINSIC_REWARD: nothing, **ends})

    def _forget_outcome(self) -> None:
        """What the step before attained, met and completed does not happen again."""
        for key, value in self._entries.items():
            if key.endswith(keys.ATTAINED) or key in (keys.SUCCESS, keys.HAZARD):
                value[:] = False

    @property
    def action_numbers(self) -> tuple[int, ...]:
        """The environment's number of each action."""
        return tuple(self._actions.tolist())

    @property
    def num_worlds(self) -> int:
        """N."""
        return self.batch_size[0]

    def _tensordict(self, entries: dict[str, NDArray]) -> TensorDict:
        """Copies of the arrays, flat ones ``[N]`` as columns ``[N, 1]``."""
        tensors = {key: to_device(torch.tensor(array), self.device) for key, array in entries.items()}
        columns = {
            key: each.unsqueeze(-1) if each.ndim == 1 and key != keys.OBSERVATION else each
            for key, each in tensors.items()
        }
        return TensorDict(columns, batch_size=self.batch_size, device=self.device)

    @property
    def world(self) -> Any:
        """The first world without its wrappers.

        Raises:
            AttributeError: if worlds cannot be looked into.
        """
        return self.worlds.vector.envs[0].unwrapped  # type: ignore[attr-defined]

    @property
    def observation_parts(self) -> tuple[tuple[str, int], ...]:
        """Names and sizes of the entries that a vector is joined from; empty if it is not."""
        return self._reading.encoder.parts

    def render(self) -> Any:
        """A picture of the first world ``[height, width, 3]``, if it makes one."""
        return None if self._render is None else self._render()

    def state_dict(self, *args, **kwargs) -> dict[str, Any]:
        """Episodes in progress and random numbers: what a resumed run needs."""
        entries = {key: torch.tensor(value) for key, value in self._entries.items()}
        return {"entries": entries, "worlds": self.worlds.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any], strict: bool = True) -> None:
        """Restores what :meth:`state_dict` returned.

        Episodes that cannot be brought back end with the next step as by a time limit, and a warning says so.

        Raises:
            ValueError: if it is the state of another number of worlds.
        """
        if not strict and "entries" not in state_dict:
            return
        entries = {key: value.cpu().numpy().copy() for key, value in state_dict["entries"].items()}
        if entries and len(entries[keys.OBSERVATION]) != self.num_worlds:
            raise ValueError(f"state_dict must hold {self.num_worlds} worlds, got {len(entries[keys.OBSERVATION])}.")
        self._entries, self._lost = entries, False
        if not entries:
            return
        told, stored = entries[keys.OBSERVATION], state_dict["worlds"]
        shown = None if stored is None else self.worlds.load_state_dict(stored)
        self._lost = shown is None or bool((shown[keys.OBSERVATION] != told).any())
        if self._lost:
            self.worlds.seed(zlib.crc32(told.tobytes()))  # not that of the first episodes again
            warnings.warn(
                "the episodes in progress could not be brought back as they were: they are cut off, and new ones "
                "begin. This training will not be bit for bit what it would have been without the interruption.",
                stacklevel=2,
            )
