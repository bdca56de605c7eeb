"""Tensors that stand in for those of a GPU."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor
from torch.utils._pytree import tree_leaves


class Elsewhere(Tensor):
    """A tensor that can't become an array, nor be combined with the host's tensors (except single numbers)."""

    @classmethod
    def __torch_function__(cls, function, types, args=(), kwargs=None):
        if function is Tensor.numpy:
            raise TypeError("can't convert a tensor of a device to numpy")
        if function is Tensor.cpu:
            return args[0].as_subclass(Tensor)
        given = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        if any(type(each) is Tensor and each.ndim for each in given):
            raise RuntimeError(f"{function.__name__}: expected all tensors to be on the same device")
        return super().__torch_function__(function, types, args, kwargs or {})


def elsewhere(state):
    """A state as if its checkpoint had been loaded onto a GPU: with all of its tensors there."""
    if isinstance(state, Tensor):
        return state.clone().as_subclass(Elsewhere)
    if isinstance(state, TensorDictBase):
        return state.apply(elsewhere)
    if isinstance(state, dict):
        return {key: elsewhere(value) for key, value in state.items()}
    return type(state)(map(elsewhere, state)) if isinstance(state, (list, tuple)) else state
