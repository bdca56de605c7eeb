"""Predicting the next observations from the memory: an auxiliary task that teaches the memory what to keep.

Q-learning tells a recurrent network little about what to remember, as a remembered place affects values only when it
is used. To predict the next observations, the memory must hold where the agent is and what surrounds it (Guo et al.,
2018; Gregor et al., 2019). There is theory for this as well: a memory that predicts observations and rewards is
sufficient for optimal control (approximate information states; Subramanian et al., 2022).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hdrqn_torchrl.modules.decoders import DecoderFactory
from hdrqn_torchrl.modules.sizes import check_size


class ObservationPredictor(nn.Module):
    """Predicts the observation after the next k actions from the memory, for 1 <= k <= ``max_steps``.

    Args:
        make_decoder: makes the decoder for the observation.
        hidden_size: H, size of the memory's output.
        num_actions: A.
        max_steps: largest k.
        width: number of units in the hidden layer.

    Raises:
        ValueError: if a value breaks its rule.

    Examples:
        >>> from hdrqn_torchrl.modules import CellDecoder
        >>> predictor = ObservationPredictor(lambda size: CellDecoder(size, 5, 5), hidden_size=8, num_actions=4)
        >>> memory, action = torch.zeros(2, 7, 8), torch.zeros(2, 7, dtype=torch.int64)
        >>> observation = torch.zeros(2, 7, 5, 5, dtype=torch.uint8)
        >>> predictor(memory, action, observation, steps=3).shape
        torch.Size([2, 4])
    """

    def __init__(
        self, make_decoder: DecoderFactory, *, hidden_size: int, num_actions: int, max_steps: int = 4, width: int = 128
    ) -> None:
        super().__init__()
        for name, value, usual in (
            ("max_steps", max_steps, 4),
            ("width", width, 128),
            ("hidden_size", hidden_size, 128),
        ):
            check_size(name, value, usual)
        check_size("num_actions", num_actions, "the number of the environment's actions")
        self.max_steps, self.num_actions = max_steps, num_actions
        self.memory = nn.Linear(hidden_size, width)
        self.actions = nn.Embedding(max_steps * num_actions, width)  # one for each action at each place in the sequence
        self.horizon = nn.Embedding(max_steps, width)
        self.decoder = make_decoder(width)

    def forward(self, memory: Tensor, action: Tensor, observation: Tensor, *, steps: int) -> Tensor:
        """Errors of all predictions k = ``steps`` ahead, along sequences.

        Args:
            memory: output of the LSTM after each step's observation, ``[B, T, H]``.
            action: ``[B, T]`` int64.
            observation: ``[B, T, ...]``.
            steps: k.

        Returns:
            ``[B, T - k]``: the error of the prediction made at step t of the observation at step t + k.
        """
        last = memory.shape[1] - steps
        place = torch.arange(steps, device=action.device) * self.num_actions
        taken = self.actions(action.unfold(1, steps, 1)[:, :last] + place).sum(-2)
        expected = torch.relu(self.memory(memory[:, :last]) + self.horizon.weight[steps - 1] + taken)
        return self.decoder.error(expected, observation[:, steps:])
