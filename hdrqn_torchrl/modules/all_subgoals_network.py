"""hDRQNv3's network: one memory for the whole episode, and the Q-values of all levels computed from it.

The LSTM reads the observation and the previous action but not the subgoal, and is not reset between options. Each level
has a dueling head on its output. In acting and in learning, one pass computes the Q-values of all levels for every
subgoal that they can be given.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from hdrqn_torchrl.devices import on_host
from hdrqn_torchrl.modules.features import Features
from hdrqn_torchrl.modules.lstm import Gaps, lstm_weights, remember_for, restarting_lstm
from hdrqn_torchrl.modules.prediction import ObservationPredictor
from hdrqn_torchrl.modules.q_network import ExactLinear, State, dueling
from hdrqn_torchrl.modules.sizes import check_size


class AllSubgoalsNetwork(nn.Module):
    """Q-values of all levels from one memory: of every choice, for every subgoal that the level can be given.

    Level 0 chooses among A actions, level l > 0 among :math:`X_l` subgoals. What a level pursues is one of the choices
    of the level above (:math:`C_l = X_{l+1}`); the top level pursues the task (:math:`C = 1`).

    Args:
        features: maps observations to vectors of ``features.out_features``.
        num_actions: A.
        num_subgoals: size of each set of subgoals, from near to far, or of the only one; empty: a flat agent.
        hidden_size: H, size of the LSTM.
        head_size: number of units in the hidden layer of each head.
        joint: whether the top level also trains the memory; ``False``: it only reads it.
        memory_span: the steps that a new memory keeps things for; see :func:`~hdrqn_torchrl.modules.lstm.remember_for`.
        predictor: predicts observations from the memory, as an auxiliary task; not used for acting.

    Raises:
        ValueError: if a size is not positive.

    Examples:
        >>> from hdrqn_torchrl.modules.features import FullyConnectedFeatures
        >>> network = AllSubgoalsNetwork(FullyConnectedFeatures(6, (8,)), num_actions=4, num_subgoals=2, hidden_size=16)
        >>> observation, previous_action = torch.zeros(3, 5, 6), torch.zeros(3, 5, dtype=torch.int64)
        >>> init, mask = torch.zeros(3, 5, dtype=torch.bool), torch.ones(3, 5, 2, dtype=torch.bool)
        >>> (action_value, subgoal_value), memory = network.unroll(observation, previous_action, init, [mask])
        >>> action_value.shape, subgoal_value.shape, memory.shape
        (torch.Size([3, 5, 2, 4]), torch.Size([3, 5, 1, 2]), torch.Size([3, 5, 16]))
    """

    _one_hot: Tensor

    def __init__(
        self,
        features: Features,
        *,
        num_actions: int,
        num_subgoals: int | Sequence[int],
        hidden_size: int = 128,
        head_size: int = 128,
        joint: bool = True,
        memory_span: int = 0,
        predictor: ObservationPredictor | None = None,
    ) -> None:
        super().__init__()
        for name, value in (("hidden_size", hidden_size), ("head_size", head_size)):
            check_size(name, value, 128)
        check_size("num_actions", num_actions, "the number of the environment's actions")
        subgoals = list(num_subgoals) if isinstance(num_subgoals, Sequence) else [num_subgoals]
        for number in subgoals:
            check_size("num_subgoals", number, "the number of the task's subgoals")
        self.features, self.hidden_size, self.joint = features, hidden_size, joint
        self.predictor = predictor
        self.num_actions, self.num_subgoals = num_actions, tuple(subgoals)
        self.register_buffer("_one_hot", torch.eye(num_actions), persistent=False)
        self.memory = nn.LSTM(features.out_features + num_actions, hidden_size, batch_first=True)
        remember_for(self.memory, memory_span)
        self._conditions = [*subgoals, 1]
        # What a subgoal is worth depends on which are left: the heads read that, so the memory need not keep track.
        inputs = [hidden_size, *(hidden_size + number for number in subgoals)]
        outputs = [
            conditions * (1 + choices)
            for conditions, choices in zip(self._conditions, [num_actions, *subgoals], strict=True)
        ]
        heads = [_head(number, head_size, out) for number, out in zip(inputs, outputs, strict=True)]
        self.sub_head, self.middle_heads = heads[0], nn.ModuleList(heads[1:-1])
        if subgoals:
            self.meta_head = heads[-1]

    def initial_state(self, *batch: int) -> State:
        """Zero LSTM state, two tensors ``[*batch, H]``."""
        zeros = self._one_hot.new_zeros((*batch, self.hidden_size))
        return zeros, zeros.clone()

    def _inputs(self, observation: Tensor, previous_action: Tensor, init: Tensor) -> list[Tensor]:
        action = self._one_hot[previous_action] * ~init.unsqueeze(-1)  # none at the first step of an episode
        return [self.features(observation), action]

    def _values(self, hidden: Tensor, masks: Sequence[Tensor]) -> tuple[Tensor, ...]:
        heads = [*self.middle_heads, *([self.meta_head] if masks else [])]
        raw = [self.sub_head(hidden)]
        for head, mask in zip(heads, masks, strict=True):
            remembered = hidden.detach() if head is heads[-1] and not self.joint else hidden
            raw.append(head(torch.cat([remembered, mask.to(hidden.dtype)], -1)))
        return tuple(
            dueling(value.unflatten(-1, (number, -1))) for value, number in zip(raw, self._conditions, strict=True)
        )

    def step(
        self, observation: Tensor, previous_action: Tensor, init: Tensor, masks: Sequence[Tensor], state: State
    ) -> tuple[tuple[Tensor, ...], State]:
        """Q-values at one step.

        Args:
            observation: ``[*, ...]``.
            previous_action: ``[*]`` int64; not read where ``init`` is set.
            init: ``[*]`` bool; where set, the state restarts from zero.
            masks: for each set, the subgoals that can be chosen, ``[*, G]`` bool.
            state: LSTM state, two tensors ``[*, H]``.

        Returns:
            Q-values of each level ``[*, C, X]``, and the state after ``observation``.
        """
        inputs = torch.cat(self._inputs(observation, previous_action, init), -1)
        state = tuple(part.masked_fill(init.unsqueeze(-1), 0.0) for part in state)  # type: ignore[assignment]
        if inputs.ndim == 1:
            advanced = torch.lstm_cell(inputs[None], [part[None] for part in state], *lstm_weights(self.memory))
            hidden, cell = (part[0] for part in advanced)
        else:
            hidden, cell = torch.lstm_cell(inputs, state, *lstm_weights(self.memory))
        return self._values(hidden, masks), (hidden, cell)

    def unroll(
        self,
        observation: Tensor,
        previous_action: Tensor,
        init: Tensor,
        masks: Sequence[Tensor],
        state: State | None = None,
    ) -> tuple[tuple[Tensor, ...], Tensor]:
        """Q-values along sequences.

        Args:
            observation, previous_action, init, masks: as in :meth:`step`, ``[B, T, ...]``.
            state: LSTM state before the first step, two tensors ``[B, H]``; zero if not given.

        Returns:
            Q-values of each level ``[B, T, C, X]``, and the output of the memory ``[B, T, H]``.
        """
        state = self.initial_state(len(init)) if state is None else state
        if not on_host(init):
            inputs = torch.cat(self._inputs(observation, previous_action, init), -1)
            memory = restarting_lstm(self.memory, inputs, init, state)
            return self._values(memory, masks), memory
        gaps = Gaps(init)
        parts = self._inputs(*(gaps.insert(steps) for steps in (observation, previous_action, init)))
        memory = gaps.lstm(self.memory, parts, state)
        values = self._values(memory, [gaps.insert(mask) for mask in masks])
        return tuple(gaps.remove(value) for value in values), gaps.remove(memory)


def _head(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(inplace=True), ExactLinear(hidden, outputs))
