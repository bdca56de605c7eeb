"""What all losses on replayed sequences have in common."""

from __future__ import annotations

from copy import deepcopy
from operator import attrgetter
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.objectives.utils import distance_loss

from hdrqn_torchrl.modules import ObservationPredictor
from hdrqn_torchrl.objectives.prediction import draw_ahead, prediction_loss
from hdrqn_torchrl.objectives.sequences import step_of
from hdrqn_torchrl.objectives.targets import double_q_value, importance_weight, training_mask

LossFunction = Literal["l2", "smooth_l1"]


class SequenceLoss(LossModule):
    """A TD loss on sequences ``[B, T]``, by a network and its target network.

    Both are unrolled once over the inputs of a sequence, so that they see the same context. A subclass computes
    targets; here is what it needs besides: the two networks, Double Q-learning, which steps are trained, means over
    them, weights of sequences drawn by priority, and the error of a predictor. Its ``tensor_keys`` must name ``mask``
    (padding) and ``priority_weight``.

    Args:
        network: what is trained. In recurrent mode it reads whole sequences.
        name: of the network; its parameters are ``<name>_params`` and ``target_<name>_params``.

    Keyword Args:
        burn_in: share of each sequence left out of the loss at its beginning.
        train_exact_states: train leading steps, too, whose recurrent state is exact.
        lookahead: steps at the end of each sequence that are there for the targets of those before and are not trained
            themselves; ``burn_in`` is a share of the others.
        double: choose the next action by the main network (Double DQN) instead of the target network.
        loss_function: ``"l2"`` or ``"smooth_l1"`` (Huber).
        predictor: part of the network that predicts observations from its memory; its error joins the loss.
        prediction_weight: of that error; 0: it is not computed.
        delay_value: whether a target network is kept (update it with TorchRL's ``SoftUpdate`` or ``HardUpdate``).

    Raises:
        ValueError: if an argument breaks its rule.
    """

    out_keys: list[NestedKey]

    def __init__(
        self,
        network: TensorDictModuleBase,
        name: str,
        *,
        burn_in: float,
        train_exact_states: bool,
        lookahead: int,
        double: bool,
        loss_function: LossFunction,
        predictor: ObservationPredictor | None,
        prediction_weight: float,
        delay_value: bool = True,
    ) -> None:
        if not 0.0 <= burn_in < 1.0:
            raise ValueError(f"burn_in must lie in [0, 1), got {burn_in}; use 0.5, or 0 to train all steps.")
        if lookahead < 0:
            raise ValueError(f"lookahead must be >= 0 steps, got {lookahead}; use target_lookahead().")
        if loss_function not in ("l2", "smooth_l1"):
            raise ValueError(f"loss_function must be 'l2' or 'smooth_l1', got {loss_function!r}; the paper uses 'l2'.")
        if prediction_weight < 0.0:
            raise ValueError(f"prediction_weight must be >= 0, got {prediction_weight}; use 0.1, or no predictor.")
        super().__init__()
        self.convert_to_functional(network, name, create_target_params=delay_value)
        # Both networks as they are called, outside the module tree: their parameters are those registered above.
        # Calling them directly saves two parameter swaps an update.
        target = network
        if delay_value:
            target = deepcopy(network)
            self._modules[f"target_{name}_params"].to_module(target, preserve_module_state=False)
        self.__dict__["_networks"] = (network, target)
        self._registered = (f"{name}_params", f"target_{name}_params")[: 1 + delay_value]
        self.__dict__["_predictor"] = predictor  # its parameters are the network's
        self.burn_in, self.train_exact_states, self.lookahead = burn_in, train_exact_states, lookahead
        self.double_q, self.loss_function, self.prediction_weight = double, loss_function, prediction_weight
        self.ahead: int | None = None
        """How many steps ahead the predictor is trained; ``None``: it is drawn again at every call."""
        if self._predicts:
            self.out_keys = [*self.out_keys, "prediction_loss"]

    def __setstate__(self, state: dict[str, Any]) -> None:
        """A copy's registered parameters are those that its networks hold: tensordicts copy theirs on their own."""
        super().__setstate__(state)
        for name, network in zip(self._registered, self._networks, strict=False):
            with self._modules[name].unlock_() as registered:
                for key in list(registered.keys(True, True)):  # a target network holds tensors, not parameters
                    registered.set(key, attrgetter(".".join((key,) if isinstance(key, str) else key))(network))

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        """The keys are read at every call; nothing to pass on."""

    @property
    def _predicts(self) -> bool:
        return self._predictor is not None and self.prediction_weight > 0.0

    def draw_ahead(self, length: int) -> int | None:
        """A number for :attr:`ahead`, as a call on sequences of ``length`` entries would draw it.

        It is all that a call draws on the host, so that what follows from it can be captured.
        """
        if self._predictor is None or not self._predicts:
            return None
        return draw_ahead(self._predictor, length - min(self.lookahead, 1))

    def _valid(self, tensordict: TensorDictBase) -> Tensor:
        """Which steps are not padding, ``[B, T]`` bool."""
        mask = tensordict.get(self.tensor_keys.mask, None)
        if mask is None:
            return torch.ones(tensordict.shape, dtype=torch.bool, device=tensordict.device)
        return step_of(mask, tensordict)

    def _warm(self, valid: Tensor, init: Tensor, lookahead: int) -> Tensor:
        """Which steps may be trained as far as the recurrent state is concerned, ``[B, T]`` bool."""
        return training_mask(valid, init, self.burn_in, self.train_exact_states, lookahead)

    def _double_value(self, online: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
        """The value ``[*]`` of what Q-values ``[*, A]`` of both networks say, among choices that exist (``mask``)."""
        return double_q_value(online.detach() if self.double_q else target, target, mask)

    def _distance(self, value: Tensor, target: Tensor, mask: Tensor, weight: Tensor | None) -> Tensor:
        """Mean loss over ``mask``, all ``[B, T, *]``; sequences drawn by priority have a ``weight`` ``[B, T]``."""
        error = (value - target).masked_fill(~mask, 0.0)
        distance = distance_loss(error, torch.zeros_like(error), self.loss_function)
        if weight is not None:
            distance = distance * importance_weight(weight).view(-1, *[1] * (distance.ndim - 1))
        return distance.sum() / mask.sum().clamp(min=1)

    def _prediction_loss(
        self, memory: Tensor, action: Tensor, observation: Tensor, *, valid: Tensor, cut: Tensor
    ) -> Tensor:
        """Mean error of what the memory expects (:func:`~hdrqn_torchrl.objectives.prediction.prediction_loss`)."""
        assert self._predictor is not None
        return prediction_loss(self._predictor, memory, action, observation, valid=valid, cut=cut, ahead=self.ahead)


def masked_mean(value: Tensor, mask: Tensor) -> Tensor:
    """Mean of the entries that ``mask`` has; 0 if it has none.

    Examples:
        >>> masked_mean(torch.tensor([1.0, 3.0, float("nan")]), torch.tensor([True, True, False]))
        tensor(2.)
    """
    return value.masked_fill(~mask, 0.0).sum() / mask.sum().clamp(min=1)
