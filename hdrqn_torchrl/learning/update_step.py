"""One update of a network as a function of tensors: all that happens between a minibatch and new weights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import Parameter
from torchrl.objectives import LossModule

from hdrqn_torchrl.learning.finite import FiniteGuard
from hdrqn_torchrl.learning.optimizer import GroupedAdam
from hdrqn_torchrl.learning.precision import Precision, matrix_products
from hdrqn_torchrl.learning.target_network import SoftTargetUpdate


class UpdateStep:
    """Loss, backward pass, norm, clipping, Adam, and target network.

    Everything that it changes are tensors that stay where they are, and unless the guard looks at once, the host reads
    none of them. So it can be captured (:class:`~hdrqn_torchrl.learning.captured.Captured`).

    Args:
        loss: reads a minibatch.
        parameters: what is trained, by name.
        optimizer: of these parameters.
        target_updater: moves the target network.
        guard: looks at loss and gradients.
        max_grad_norm: gradients are clipped to this norm; ``None``: they are not clipped.
    """

    def __init__(
        self,
        loss: LossModule,
        parameters: Mapping[str, Parameter],
        *,
        optimizer: GroupedAdam,
        target_updater: SoftTargetUpdate,
        guard: FiniteGuard,
        max_grad_norm: float | None,
    ) -> None:
        self.loss, self.parameters, self.optimizer = loss, parameters, optimizer
        self.target_updater, self.guard, self.max_grad_norm = target_updater, guard, max_grad_norm
        self.changes = False
        """Whether weights are being changed, or an error came between."""

    def draw_ahead(self, steps: int) -> int | None:
        """What the host decides about an update: how many steps ahead the loss predicts, if it does.

        Args:
            steps: T, of the minibatch.
        """
        draw = getattr(self.loss, "draw_ahead", None)
        return None if draw is None else draw(steps)

    def __call__(self, sample: TensorDictBase, precision: Precision, ahead: int | None = None) -> dict[str, Tensor]:
        """One gradient step on ``sample`` and one soft update of the target network.

        Args:
            sample: the minibatch ``[B, T]``.
            precision: of matrix products.
            ahead: what :meth:`draw_ahead` returned; ``None``: the loss draws it.

        Returns:
            All that the loss reports, and ``grad_norm`` if gradients are clipped; without gradient.

        Raises:
            NonFiniteError: if the guard looks at once and something is not finite.
        """
        with matrix_products(precision, next(iter(self.parameters.values())).device.type), self._predicting(ahead):
            report = dict(self.loss(sample).items())
        self.optimizer.zero_grad()
        report["loss"].backward()
        norm = self.watch_gradients(report["loss"])
        if self.max_grad_norm is not None:
            self.optimizer.clip_gradients(self.max_grad_norm, norm)
            report["grad_norm"] = norm
        self.changes = True
        self.optimizer.step()
        self.target_updater.step()
        self.changes = False
        return {name: value.detach() for name, value in report.items()}

    @contextmanager
    def _predicting(self, ahead: int | None) -> Iterator[None]:
        if ahead is None:
            yield
            return
        self.loss.ahead = ahead  # type: ignore[assignment]
        try:
            yield
        finally:
            self.loss.ahead = None  # type: ignore[assignment]

    def watch_gradients(self, loss: Tensor) -> Tensor:
        """Norm of all gradients; an update in which something is not finite goes no further."""
        gradients = {name: each.grad for name, each in self.parameters.items() if each.grad is not None}
        norm = torch.nn.utils.get_total_norm(gradients.values())
        skip = self.guard.watch(loss, gradients, norm)
        if skip is not None:
            self.optimizer.found_inf = skip  # type: ignore[attr-defined]  # read by torch's fused Adam
        return norm
