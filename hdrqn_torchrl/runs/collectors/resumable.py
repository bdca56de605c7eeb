"""A collector that goes on in mid-episode after a restart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv


class ResumableCollector(Collector):
    """TorchRL's ``Collector`` whose state includes the environment and the step that it is about to take.

    TorchRL's own leaves both out and starts new episodes when it is loaded: recurrent states, options in
    progress and the worlds themselves would be lost. The environment must return its state, its random generator
    included, from ``state_dict`` and take it back with ``load_state_dict``.

    Raises:
        ValueError: if the environment keeps its state to itself.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> collector = ResumableCollector(MultiGoalGridEnv(num_envs=2), frames_per_batch=8, total_frames=64)
        >>> batches = iter(collector)
        >>> _ = next(batches)
        >>> state = collector.state_dict()
        >>> _ = next(batches)
        >>> collector.load_state_dict(state)
        >>> collector.env.steps.tolist()
        [4, 4]
    """

    def __init__(self, *args, **kwargs) -> None:
        self._has_given_up = False
        super().__init__(*args, **kwargs)
        if _is_empty(self._base_env.state_dict()):
            raise ValueError(
                f"the environment must return its state from state_dict(), got nothing from {type(self._base_env)}; "
                "implement state_dict and load_state_dict, or use torchrl.collectors.Collector without checkpoints."
            )

    @property
    def _base_env(self):  # noqa: ANN202
        return getattr(self.env, "base_env", self.env)

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Batches ``[N, T]``. TorchRL's shuts down at an error; this one can still tell its state."""
        self._iteration_started = True
        yield from self.iterator()

    def give_up(self, frames: int) -> None:
        """Forgets a batch in which an error was raised, and the episodes in progress: where it goes on, or its state
        is loaded, new ones begin, in worlds that it has not shown before.

        Args:
            frames: of the batches that count.
        """
        self._frames, self._has_given_up = frames, True

    def rollout(self) -> TensorDictBase:
        """The next batch ``[N, T]``."""
        if self._has_given_up:
            self.env.set_seed(new_seed())
            self._make_carrier()
            self._has_given_up = False
        return super().rollout()

    def state_dict(self) -> dict[str, Any]:
        """TorchRL's state without the policy, which has a checkpoint entry of its own, and with what it lacks."""
        state = super().state_dict()
        state.pop("policy_state_dict", None)
        if self._has_given_up:
            return state
        if not isinstance(self.env, TransformedEnv):
            state["env_state_dict"] = self.env.state_dict()
        return {**state, "base_env": self._base_env.state_dict(), "carrier": self._carrier.exclude("next").clone()}

    def load_state_dict(self, state_dict: dict[str, Any], **kwargs) -> None:
        """Restores what :meth:`state_dict` returned.

        Raises:
            ValueError: if the step that was about to be taken has other entries than this environment, or it is the
                state of workers.
        """
        if "workers" in state_dict:
            raise ValueError(f"collector must be one with {len(state_dict['workers'])} workers, as before, got local.")
        super().load_state_dict(state_dict, strict=False)
        self._traj_pool.load_state_dict(state_dict["traj_pool"])  # TorchRL numbered the episodes anew
        self._has_given_up = has_given_up(state_dict)
        if self._has_given_up:
            return
        self._base_env.load_state_dict(state_dict["base_env"])
        _check_like(state_dict["carrier"], self.state_dict()["carrier"], self.env.action_keys)
        self._carrier = state_dict["carrier"].clone()
        if self._carrier_has_no_device:
            self._carrier.clear_device_()


def new_seed() -> int:
    """A seed of worlds by torch's random numbers, which a resumed training finds as they were left."""
    return int(torch.randint(2**31, ()))


def has_given_up(state: Mapping[str, Any]) -> bool:
    """Whether the state of a collector holds no episodes in progress (:meth:`ResumableCollector.give_up`)."""
    return "carrier" not in state


def _check_like(carrier: TensorDictBase, own: TensorDictBase, chosen: Sequence[NestedKey]) -> None:
    """Compares entries, apart from what a policy has chosen, which is not there before the first step."""
    found, expected = (
        {key: (value.dtype, value.shape) for key, value in each.items(True, True) if key not in chosen}
        for each in (carrier, own)
    )
    if found != expected:
        names = sorted(str(key) for key in found.keys() | expected.keys() if found.get(key) != expected.get(key))
        raise ValueError(f"the stored step must have the entries of this environment, got others: {', '.join(names)}.")


def _is_empty(state: Mapping[str, Any]) -> bool:
    """Whether a state, or that of each of several environments, holds nothing."""
    return all(isinstance(part, Mapping) and _is_empty(part) for part in state.values())
