"""Checks that an environment has the entries that its readers need, and reports all problems in one message."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torchrl.data import Composite, TensorSpec
from torchrl.envs import EnvBase


class Entries:
    """The entries of an environment by key, and the problems found with them.

    Args:
        batch_size: batch size of the environment.
        parts: specs of its observations, actions, rewards and done flags; ``None`` is skipped.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> entries = Entries.of(MultiGoalGridEnv(4))
        >>> entries.require_flags("attained", 2)
        >>> entries.require_flags("reached")
        >>> entries.problems[0]
        "'reached' must be [4, 1] bool, it is missing"
    """

    def __init__(self, batch_size: torch.Size, *parts: Composite | None) -> None:
        self.batch_size = batch_size
        self.specs: dict[NestedKey, TensorSpec] = {}
        for part in parts:
            if part is not None:
                self.specs |= {key: part[key] for key in part.keys(True, True)}
        self.problems: list[str] = []

    @classmethod
    def of(cls, env: EnvBase) -> Entries:
        """The entries of an environment, including its actions."""
        return cls(env.batch_size, env.observation_spec, env.full_action_spec, env.full_reward_spec, env.full_done_spec)

    def __contains__(self, key: NestedKey) -> bool:
        return key in self.specs

    def require_flags(self, key: NestedKey, size: int | None = 1) -> None:
        """Requires a bool entry ``[*batch, size]``; ``None``: any size from 1 on."""
        remedy = "cast it, for instance with DTypeCastTransform(dtype_in=..., dtype_out=torch.bool, in_keys=[...])"
        self._require(key, torch.bool, size, remedy)

    def require_number(self, key: NestedKey) -> None:
        """Requires a float32 entry ``[*batch, 1]``."""
        self._require(key, torch.float32, 1, "cast it, for instance with DoubleToFloat(in_keys=[...])")

    def _require(self, key: NestedKey, dtype: torch.dtype, size: int | None, remedy: str) -> None:
        spec = self.specs.get(key)
        shape = [*self.batch_size, "G" if size is None else size]
        rule = f"{key!r} must be [{', '.join(map(str, shape))}] {_name(dtype)}"
        if spec is None:
            self.problems.append(f"{rule}, it is missing")
        elif spec.shape[:-1] != self.batch_size or not spec.shape or spec.shape[-1] != (size or spec.shape[-1] or 1):
            self.problems.append(f"{rule}, got {describe(spec)}")
        elif spec.dtype != dtype:
            self.problems.append(f"{rule}, got {describe(spec)}; {remedy}")

    def check(self, reader: str) -> None:
        """Raises one error for all problems, if there were any.

        Args:
            reader: what reads the entries, for the message.

        Raises:
            ValueError: with all problems, and all entries that the environment has.
        """
        if self.problems:
            found = "\n".join(f"    {key!r}: {describe(spec)}" for key, spec in self.specs.items())
            wrong = "\n".join(f"  - {problem}" for problem in self.problems)
            raise ValueError(
                f"env must have what {reader} reads:\n{wrong}\n  Use RenameTransform for entries that have another "
                f"name. The environment, of batch size {list(self.batch_size)}, has\n{found}"
            )


def describe(spec: TensorSpec) -> str:
    """Shape, dtype and kind of a spec."""
    return f"{list(spec.shape)} {_name(spec.dtype)} ({type(spec).__name__})"


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def set_spec(composite: Composite, key: NestedKey, spec: TensorSpec) -> None:
    """Sets a nested spec, creating the composites that hold it."""
    if isinstance(key, tuple) and len(key) > 1:
        if composite.get(key[0], None) is None:
            composite[key[0]] = Composite(shape=composite.shape, device=composite.device)
        set_spec(composite[key[0]], key[1:], spec)
    else:
        composite[key[0] if isinstance(key, tuple) else key] = spec
