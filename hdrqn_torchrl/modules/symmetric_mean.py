"""Q-values of a step that are the same for an agent in a turned or mirrored world."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from hdrqn_torchrl.envs.symmetry import Symmetry, with_identity
from hdrqn_torchrl.modules.all_subgoals_network import AllSubgoalsNetwork
from hdrqn_torchrl.modules.q_network import State

PREFERENCE = 1e-5
"""How much more an action is taken to be worth than the next one: above rounding errors, below all that matters."""


class SymmetricMean(nn.Module):
    """Mean of a network's Q-values over what the step would look like in each changed world.

    The true values are the same in all of these worlds; those that a network has learned differ by its errors, of
    which the mean over the K worlds has less:

    .. math:: \\bar Q(o, a) = \\frac{1}{K} \\sum_{k=1}^{K} Q(o_k, a_k), \\qquad
        o_k[i] = o[\\mathrm{places}_k[i]], \\quad a_k = \\mathrm{actions}_k[a] .

    The network remembers each world by itself: its state is K states side by side. Where a world looks the same turned,
    actions that are each other's turned are worth the same: of these the first is preferred, lest rounding decides.

    Args:
        symmetries: of the task; leaving a world as it is comes first without being named.

    Examples:
        >>> from hdrqn_torchrl.modules.features import FullyConnectedFeatures
        >>> network = AllSubgoalsNetwork(FullyConnectedFeatures(3, (8,)), num_actions=2, num_subgoals=2, hidden_size=16)
        >>> mean = SymmetricMean([Symmetry(places=(2, 1, 0), actions=(1, 0))])
        >>> before = torch.zeros(5, dtype=torch.int64), torch.ones(5, dtype=torch.bool)  # action, first step
        >>> masks, state = [torch.ones(5, 2)], (torch.zeros(5, 2 * 16), torch.zeros(5, 2 * 16))
        >>> (action_value, _), _ = mean.step(network, torch.rand(5, 3), *before, masks, state)
        >>> action_value.shape
        torch.Size([5, 2, 2])
    """

    _places: Tensor
    _actions: Tensor
    _preferred: Tensor

    def __init__(self, symmetries: Sequence[Symmetry]) -> None:
        super().__init__()
        every = with_identity(symmetries)
        self.number = len(every)
        self.register_buffer("_places", torch.tensor([each.places for each in every]), persistent=False)
        self.register_buffer("_actions", torch.tensor([each.actions for each in every]), persistent=False)
        self.register_buffer("_preferred", -PREFERENCE * torch.arange(self._actions.shape[1]), persistent=False)

    def step(
        self,
        network: AllSubgoalsNetwork,
        observation: Tensor,
        previous_action: Tensor,
        init: Tensor,
        masks: Sequence[Tensor],
        state: State,
    ) -> tuple[tuple[Tensor, ...], State]:
        """As :meth:`.AllSubgoalsNetwork.step`, with a state of ``[*, K * H]``."""
        batch = init.shape
        seen = observation.flatten(len(batch))[..., self._places].reshape(-1, *observation.shape[len(batch) :])
        did = self._actions.t()[previous_action].flatten()
        first, *allowed = (self._for_each(entry, len(batch)) for entry in (init, *masks))
        apart = [part.unflatten(-1, (self.number, -1)).flatten(0, -2) for part in state]
        values, after = network.step(seen, did, first, allowed, (apart[0], apart[1]))
        action_value, *rest = (value.unflatten(0, (*batch, self.number)) for value in values)
        index = self._actions.unsqueeze(-2).expand_as(action_value)
        mean = [value.mean(len(batch)) for value in (action_value.gather(-1, index), *rest)]
        mean[0] = mean[0] + self._preferred
        hidden, cell = (part.unflatten(0, (*batch, self.number)).flatten(-2) for part in after)
        return tuple(mean), (hidden, cell)

    def _for_each(self, entry: Tensor, dims: int) -> Tensor:
        """The entry ``[*, ...]`` once for each world, ``[* K, ...]``."""
        repeated = entry.unsqueeze(dims).expand(*entry.shape[:dims], self.number, *entry.shape[dims:])
        return repeated.reshape(-1, *entry.shape[dims:])
