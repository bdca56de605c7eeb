"""The target network follows the one that is trained."""

from __future__ import annotations

import torch
from torchrl.objectives import LossModule, SoftUpdate


class SoftTargetUpdate(SoftUpdate):
    r"""TorchRL's ``SoftUpdate``, :math:`\theta' \leftarrow \theta' + \tau (\theta - \theta')`, in one call.

    Which parameters belong together is found once, not at every step: that took a twentieth of an update of a small
    network.

    Args:
        loss: holds both networks; the target network becomes a copy of the trained one.
        tau: the rate.
    """

    def __init__(self, loss: LossModule, *, tau: float) -> None:
        super().__init__(loss, tau=tau)
        trained = [each for part in self._sources.values() for each in part.values(True, True)]
        target = [each for part in self._targets.values() for each in part.values(True, True)]
        self._pairs = target, trained

    def step(self) -> None:
        """Moves the target network once."""
        with torch.no_grad():
            torch._foreach_lerp_(*self._pairs, 1 - self.eps)
