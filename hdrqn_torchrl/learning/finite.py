"""Keeps NaN and infinity out of the weights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hdrqn_torchrl import keys
from hdrqn_torchrl.devices import LateCheck, on_host


class NonFiniteError(ArithmeticError):
    """A number that training depends on became NaN or infinite."""


class FiniteGuard:
    """Looks at the loss and the gradients of every update before the optimiser does.

    On a CPU it looks at once. On a GPU the host would have to wait for every update; there the optimiser itself skips
    the step and all that follow (``found_inf`` of fused Adam, which never leaves the device), the first fault is kept
    on the device, and :meth:`check` reports it when called. What is kept stays in the same memory, so that a captured
    update goes on with it.

    Args:
        at_once: whether to look at every update.

    Examples:
        >>> guard, nan = FiniteGuard(at_once=False), torch.tensor(float("nan"))
        >>> guard.begin("update 7")
        >>> guard.watch(torch.tensor(2.0), {"weight": nan}, nan)
        tensor(1.)
        >>> guard.check()
        Traceback (most recent call last):
        hdrqn_torchrl.learning.finite.NonFiniteError: the gradient of weight became NaN or infinite in update 7
    """

    def __init__(self, *, at_once: bool) -> None:
        self.at_once = at_once
        self._found: Tensor | None = None  # 1.0 from the first such update on
        self._first: Tensor | None = None  # its loss, its largest gradients, and its place in _places
        self._count: Tensor | None = None  # updates since the last check
        self._names: list[str] = []
        self._places: list[str] = []  # of updates since the last check, or since the last answer
        self._dropped = 0  # updates since the last check that are known to be sound
        self._asked = 0  # of those in _places, how many the question is about whose answer is on its way
        self._late = LateCheck()

    def begin(self, place: str) -> None:
        """Takes note, on the host, of which update is next.

        Args:
            place: for the message.
        """
        if self.at_once:
            self._places.clear()
        self._places.append(place)

    def watch(self, loss: Tensor, gradients: Mapping[str, Tensor], norm: Tensor) -> Tensor | None:
        """Takes one update, after :meth:`begin`. If it does not look at once, nothing is read on the host.

        Args:
            loss: ``[]``.
            gradients: by the name of their parameter.
            norm: of all gradients together, ``[]``.

        Returns:
            What the optimiser needs to know, ``[]``: 1 if it must skip the step; ``None`` if it need not ask.

        Raises:
            NonFiniteError: if it looks at once and something is not finite.
        """
        loss = loss.detach()
        sound = torch.isfinite(loss + norm)
        if not self.at_once:
            return self._remember(sound, loss, gradients)
        if not sound:
            raise NonFiniteError(self._explain(loss, _largest(gradients), list(gradients), self._places[-1]))
        return None

    def _remember(self, sound: Tensor, loss: Tensor, gradients: Mapping[str, Tensor]) -> Tensor:
        self._names = list(gradients)
        if self._found is None or self._first is None or self._count is None:
            self._found, self._count = torch.zeros_like(loss), torch.zeros_like(loss)
            self._first = loss.new_zeros(len(gradients) + 2)
        state = torch.stack([loss, *_largest(gradients), self._count])
        self._first.copy_(torch.where(self._found > 0, self._first, state))
        self._found.copy_(torch.maximum(self._found, (~sound).to(loss.dtype)))
        self._count += 1
        return self._found

    def check(self) -> None:
        """Looks at all updates since the last check.

        Raises:
            NonFiniteError: naming what was not finite, and the first update in which it was not.
        """
        self._late.forget()
        if self._found is not None and self._found > 0:
            self._refuse()
        self._places.clear()
        self._dropped = self._asked = 0
        if self._count is not None:
            self._count.zero_()

    def check_late(self) -> None:
        """As :meth:`check`, but a GPU is not waited for: a fault may be told at the next call only.

        Raises:
            NonFiniteError: as there.
        """
        if self._found is None or on_host(self._found):
            self.check()
            return
        number = len(self._places)
        self._late.ask(self._found > 0, self._refuse)
        del self._places[: self._asked]  # by the last question, to which the answer was no
        self._dropped += self._asked
        self._asked = number - self._asked

    def _refuse(self) -> None:
        assert self._first is not None
        loss, *largest, place = self._first.unbind()
        raise NonFiniteError(self._explain(loss, largest, self._names, self._places[int(place) - self._dropped]))

    @staticmethod
    def _explain(loss: Tensor, largest: Sequence[Tensor], names: Sequence[str], place: str) -> str:
        if not torch.isfinite(loss):
            return f"the loss became {loss.item()} in {place}"
        for name, value in zip(names, largest, strict=True):
            if not torch.isfinite(value):
                return f"the gradient of {name} became NaN or infinite in {place}"
        return f"the gradient's norm became infinite in {place}"


def _largest(gradients: Mapping[str, Tensor]) -> Sequence[Tensor]:
    """Largest absolute value of each; NaN where there is one."""
    return torch._foreach_norm(list(gradients.values()), torch.inf)


def check_batch(batch: TensorDictBase, frames: int, late: LateCheck | None = None) -> None:
    """Refuses a collected batch ``[N, T]`` with a NaN or an infinity in it.

    Args:
        batch: what was collected.
        frames: before it.
        late: where the question is asked; ``None``: here and now.

    Raises:
        NonFiniteError: naming the place and the entry that came first; others follow from it.
    """
    floats = [value for value in batch.values(True, True) if value.is_floating_point()]
    wrong = ~torch.stack([torch.isfinite(value).all() for value in floats]).all()
    refuse = partial(_refuse_batch, batch, frames)
    if late is not None:
        late.ask(wrong, refuse)
    elif wrong:
        refuse()


def _refuse_batch(batch: TensorDictBase, frames: int) -> None:
    found = []
    for key, value in batch.items(True, True):
        if value.is_floating_point() and not torch.isfinite(value).all():
            wrong = ~torch.isfinite(value).reshape(*batch.shape, -1).all(-1)
            time, environment = wrong.t().nonzero()[0].tolist()
            name = ".".join(key) if isinstance(key, tuple) else key
            found.append((time, *(cause not in name for cause in (keys.OBSERVATION, keys.REWARD)), name, environment))
    *_, name, environment = min(found)
    raise NonFiniteError(f"{name} holds a NaN or an infinity, environment {environment}, after frame {frames}")


@contextmanager
def naming(learner: str) -> Iterator[None]:
    """Puts the learner's name before its error."""
    try:
        yield
    except NonFiniteError as error:
        raise NonFiniteError(f"{learner}: {error}") from error
