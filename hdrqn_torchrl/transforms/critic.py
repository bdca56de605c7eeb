"""Custom subgoals for any environment: a function says which of them a step attained."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.data import Binary, Composite
from torchrl.envs.transforms import Transform

from hdrqn_torchrl import keys
from hdrqn_torchrl.transforms.entries import set_spec

Verdict = Callable[[TensorDictBase], Tensor]
"""Returns the subgoals that a step attained, ``[*batch, G]`` bool, from what follows the step ``[*batch]``."""


class Critic(Transform):
    """Writes ``attained`` as a function computes it; what the environment itself wrote there is replaced.

    An environment with it has all that builders require, at every level: the option book, losses that teach all
    subgoals, hindsight and the monitors read the same entry.

    Args:
        num_subgoals: G.
        verdict: which subgoals a step attained. A reset attains none.
        names: of the subgoals; ``None``: numbers.
        prefix: of the entries that concern this set of subgoals (:class:`~hdrqn_torchrl.keys.OptionKeys`); empty for
            the farthest one.
        repeatable: whether a subgoal can be attained more than once in an episode.
        attained_key: the entry written; ``None``: ``attained`` with the prefix.
        keeps_available: whether the environment's ``available`` is about these subgoals. It is taken out otherwise (but
            with an ``attained_key`` of its own), as it is about those that are replaced.

    Raises:
        ValueError: if ``num_subgoals`` is not positive, there is another number of names, or, in a step, if the verdict
            is of another shape or dtype than ``[*, G]`` bool.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> def heights(after):
        ...     return torch.stack([after["observation"][..., 0].abs() > limit for limit in (0.1, 0.2)], -1)
        >>> env = TransformedEnv(GymEnv("CartPole-v1"), Critic(2, heights))
        >>> env.rollout(3)["next", "attained"].shape
        torch.Size([3, 2])
    """

    def __init__(
        self,
        num_subgoals: int,
        verdict: Verdict,
        *,
        names: Sequence[str] | None = None,
        prefix: str = "",
        repeatable: bool = False,
        attained_key: NestedKey | None = None,
        keeps_available: bool = False,
    ) -> None:
        if not isinstance(num_subgoals, int) or num_subgoals < 1:
            raise ValueError(
                f"num_subgoals must be a whole number >= 1, got {num_subgoals!r}; count the verdict's columns."
            )
        if not callable(verdict):
            raise ValueError(f"verdict must be a function of what followed a step, got {verdict!r}.")
        if names is not None and len(names) != num_subgoals:
            raise ValueError(f"names must be one for each of {num_subgoals} subgoals, got {len(names)}.")
        self.attained_key = attained_key or keys.OptionKeys(prefix).attained
        replaces = attained_key is None and not keeps_available
        self._replaced = keys.OptionKeys(prefix).available if replaces else None
        super().__init__(in_keys=[], out_keys=[self.attained_key])
        self.num_subgoals, self.verdict = num_subgoals, verdict
        self.names = tuple(names or (f"subgoal {index}" for index in range(num_subgoals)))
        self.prefix, self.repeatable = prefix, repeatable

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        attained = self.verdict(next_tensordict)
        shape = [*next_tensordict.batch_size, self.num_subgoals]
        fits = isinstance(attained, Tensor) and list(attained.shape) == shape and attained.dtype == torch.bool
        if not fits:
            got = f"{list(attained.shape)} {attained.dtype}" if isinstance(attained, Tensor) else repr(attained)
            raise ValueError(
                f"verdict must return which of num_subgoals={self.num_subgoals} subgoals a step attained, {shape} "
                f"torch.bool, got {got}; compare, and stack along the last dimension."
            )
        return self._without(next_tensordict).set(self.attained_key, attained)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        shape = (*tensordict_reset.batch_size, self.num_subgoals)
        attained = torch.zeros(shape, dtype=torch.bool, device=tensordict_reset.device)
        return set_where_reset(tensordict, self._without(tensordict_reset), {self.attained_key: attained})

    def _without(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Takes out what the environment says of the subgoals that are replaced."""
        if self._replaced is not None and self._replaced in tensordict:
            tensordict.del_(self._replaced)
        return tensordict

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._reset(tensordict, tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        shape = (*observation_spec.shape, self.num_subgoals)
        if self._replaced is not None and observation_spec.get(self._replaced, None) is not None:
            del observation_spec[self._replaced]
        set_spec(
            observation_spec, self.attained_key, Binary(shape=shape, dtype=torch.bool, device=observation_spec.device)
        )
        return observation_spec


def set_where_reset(
    tensordict: TensorDictBase, tensordict_reset: TensorDictBase, fresh: dict[NestedKey, Tensor]
) -> TensorDictBase:
    """Sets entries ``fresh`` in what a reset returned; environments that go on keep what they had.

    Args:
        tensordict: what the reset was called with; ``"_reset"`` names the environments concerned, if not all.
        tensordict_reset: what it returned.
        fresh: values at the start of an episode.
    """
    reset = tensordict.get("_reset", None)
    for key, value in fresh.items():
        if reset is not None and (kept := tensordict.get(key, None)) is not None:
            value = torch.where(expand_as_right(reset.view(tensordict.batch_size), kept), value, kept)
        tensordict_reset.set(key, value)
    return tensordict_reset
