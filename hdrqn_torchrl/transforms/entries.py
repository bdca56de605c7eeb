"""Whether an environment has the entries that something reads: all that is wrong, in one message."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torchrl.data import Composite, TensorSpec
from torchrl.envs import EnvBase


class Entries:
    """The entries of an environment, by key, and what was found wrong with them.

    Args:
        batch_size: of the environment.
        parts: specs of its observations, rewards and ends of episodes.

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
        """Those of an environment, actions included."""
        return cls(env.batch_size, env.observation_spec, env.full_action_spec, env.full_reward_spec, env.full_done_spec)

    def __contains__(self, key: NestedKey) -> bool:
        return key in self.specs

    def require_flags(self, key: NestedKey, size: int | None = 1) -> None:
        """Bool entries ``[*batch, size]``; ``None``: of any size from 1 on."""
        remedy = "cast it, with DTypeCastTransform(dtype_in=..., dtype_out=torch.bool, in_keys=[...]) for instance"
        self._require(key, torch.bool, size, remedy)

    def require_number(self, key: NestedKey) -> None:
        """An entry ``[*batch, 1]`` of float32."""
        self._require(key, torch.float32, 1, "cast it, with DoubleToFloat(in_keys=[...]) for instance")

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
        """Ends with one message if something was wrong.

        Args:
            reader: who reads the entries.

        Raises:
            ValueError: naming all problems, and all that the environment has.
        """
        if self.problems:
            found = "\n".join(f"    {key!r}: {describe(spec)}" for key, spec in self.specs.items())
            wrong = "\n".join(f"  - {problem}" for problem in self.problems)
            raise ValueError(
                f"env must have what {reader} reads:\n{wrong}\n  Entries that have another name can be given the right "
                f"one with RenameTransform. The environment, of batch size {list(self.batch_size)}, has\n{found}"
            )


def describe(spec: TensorSpec) -> str:
    """Shape, dtype and kind of a spec."""
    return f"{list(spec.shape)} {_name(spec.dtype)} ({type(spec).__name__})"


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def set_spec(composite: Composite, key: NestedKey, spec: TensorSpec) -> None:
    """Sets a nested spec, making the composites on its way."""
    if isinstance(key, tuple) and len(key) > 1:
        if composite.get(key[0], None) is None:
            composite[key[0]] = Composite(shape=composite.shape, device=composite.device)
        set_spec(composite[key[0]], key[1:], spec)
    else:
        composite[key[0] if isinstance(key, tuple) else key] = spec
