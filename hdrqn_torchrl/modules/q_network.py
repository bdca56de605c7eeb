"""Features -> recurrent layer (or none) -> dueling Q-values (figure 3 of the paper)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pack_padded_sequence

from hdrqn_torchrl.devices import autocast_dtype, on_host
from hdrqn_torchrl.modules.features import Features
from hdrqn_torchrl.modules.lstm import lstm_weights, remember_for, restarting_lstm
from hdrqn_torchrl.modules.prediction import ObservationPredictor
from hdrqn_torchrl.modules.sizes import check_size

State = tuple[Tensor, Tensor]


class DuelingHead(nn.Module):
    """Q = V + A - mean(A), with value and advantage as two linear streams (Wang et al., 2015).

    Args:
        in_features: D of the features ``[*, D]``.
        num_actions: A of the Q-values ``[*, A]``.

    Raises:
        ValueError: if a size is not positive.

    Examples:
        >>> DuelingHead(8, num_actions=4)(torch.zeros(2, 5, 8)).shape
        torch.Size([2, 5, 4])
    """

    def __init__(self, in_features: int, num_actions: int) -> None:
        super().__init__()
        check_size("in_features", in_features, 128)
        check_size("num_actions", num_actions, 4)
        self.streams = ExactLinear(in_features, 1 + num_actions)

    def forward(self, features: Tensor) -> Tensor:
        return dueling(self.streams(features))


class ExactLinear(nn.Linear):
    """A dense layer that keeps its precision under autocast.

    It computes Q-values; in a lower precision, values that differ by little would become equal.
    """

    def forward(self, inputs: Tensor) -> Tensor:
        if autocast_dtype(inputs) is None:
            return super().forward(inputs)
        with torch.autocast(inputs.device.type, enabled=False):
            return super().forward(inputs.to(self.weight.dtype))


def dueling(streams: Tensor) -> Tensor:
    """Q-values ``[*, A]`` from a value and A advantages ``[*, 1 + A]``."""
    value, advantage = streams[..., :1], streams[..., 1:]
    return value + advantage - advantage.mean(-1, keepdim=True)


class QNetwork(nn.Module):
    """Q-values of every action from an observation, an optional condition and a recurrent state.

    Args:
        features: maps observations to vectors of ``features.out_features``.
        num_actions: A.
        hidden_size: H, size of the recurrent layer (or of the dense layer in its place).
        num_conditions: number of values of an integer condition (the subgoal), which is appended to the features as
            a one-hot vector; 0 for no condition.
        gate_features: whether the condition also scales each feature by a learned factor. Only appended, it is a weak
            signal: "go to goal k" needs the product of what is seen and which goal is wanted.
        recurrent: ``False`` replaces the LSTM by a dense layer with ReLU.
        memory_span: the steps that a new memory keeps things for; see :func:`~hdrqn_torchrl.modules.lstm.remember_for`.
        predictor: predicts observations from the memory, as an auxiliary task; not used for acting.

    Raises:
        ValueError: if a size breaks its rule, or there is a predictor without a memory.

    Examples:
        >>> from hdrqn_torchrl.modules.features import FullyConnectedFeatures
        >>> network = QNetwork(FullyConnectedFeatures(6, (8,)), num_actions=4, hidden_size=16, num_conditions=2)
        >>> state = network.initial_state(3)
        >>> q, state = network.step(torch.zeros(3, 6), torch.tensor([0, 1, 1]), state)
        >>> q.shape, network.unroll(torch.zeros(3, 5, 6), torch.zeros(3, 5, dtype=torch.int64)).shape
        (torch.Size([3, 4]), torch.Size([3, 5, 4]))
    """

    _one_hot: Tensor

    def __init__(
        self,
        features: Features,
        *,
        num_actions: int,
        hidden_size: int,
        num_conditions: int = 0,
        gate_features: bool = False,
        recurrent: bool = True,
        memory_span: int = 0,
        predictor: ObservationPredictor | None = None,
    ) -> None:
        super().__init__()
        if predictor is not None and not recurrent:
            raise ValueError("predictor must be None with recurrent=False: there is no memory to train.")
        check_size("hidden_size", hidden_size, "256, as in the paper")
        check_size("num_actions", num_actions, "the number of the environment's actions, or of its subgoals")
        check_size("num_conditions", num_conditions, "the number of subgoals, or 0 for none", least=0)
        self.features, self.hidden_size, self.recurrent = features, hidden_size, recurrent
        self.num_actions, self.num_conditions = num_actions, num_conditions
        self.predictor = predictor
        size = features.out_features + num_conditions
        if recurrent:
            self.memory: nn.Module = nn.LSTM(size, hidden_size, batch_first=True)
            remember_for(self.memory, memory_span)
        else:
            self.memory = nn.Sequential(nn.Linear(size, hidden_size), nn.ReLU())
        self.register_buffer("_one_hot", torch.eye(num_conditions), persistent=False)
        self.gate = None
        if gate_features and num_conditions:
            self.gate = nn.Embedding(num_conditions, features.out_features)
            nn.init.normal_(self.gate.weight, 1.0, 0.5)
        self.head = DuelingHead(hidden_size, num_actions)

    def initial_state(self, *batch: int) -> State:
        """Zero LSTM state, two tensors ``[*batch, H]``."""
        zeros = self.head.streams.weight.new_zeros((*batch, self.hidden_size))
        return zeros, zeros.clone()

    def _embed(self, observation: Tensor, condition: Tensor | None) -> Tensor:
        features = self.features(observation)
        if condition is None:
            return features
        if self.gate is not None:
            features = features * self.gate(condition)
        return torch.cat([features, self._one_hot[condition]], -1)

    def _cell(self, features: Tensor, state: State) -> State:
        memory = self.memory
        assert isinstance(memory, nn.LSTM)
        return torch.lstm_cell(features, state, *lstm_weights(memory))

    def step(self, observation: Tensor, condition: Tensor | None, state: State) -> tuple[Tensor, State]:
        """Q-values ``[*, A]`` and the new state, from ``observation`` ``[*, ...]`` and ``condition`` ``[*]``."""
        features = self._embed(observation, condition)
        if features.ndim == 1:
            hidden, cell = self._cell(features[None], (state[0][None], state[1][None]))
            hidden, cell = hidden[0], cell[0]
        else:
            hidden, cell = self._cell(features, state)
        return self.head(hidden), (hidden, cell)

    def evaluate(self, observation: Tensor, condition: Tensor | None = None) -> Tensor:
        """Q-values ``[*, A]`` of a network without memory."""
        return self.head(self.memory(self._embed(observation, condition)))

    def unroll(
        self,
        observation: Tensor,
        condition: Tensor | None = None,
        init: Tensor | None = None,
        state: State | None = None,
    ) -> Tensor:
        """Q-values along sequences.

        Args:
            observation: ``[B, T, ...]``.
            condition: ``[B, T]`` int64, or ``None`` if the network has no condition.
            init: ``[B, T]`` bool; where set, the state restarts from zero before that step.
            state: LSTM state before the first step, two tensors ``[B, H]``; zero if not given.

        Returns:
            ``[B, T, A]``.
        """
        return self.head(self.remember(observation, condition, init, state))

    def remember(
        self,
        observation: Tensor,
        condition: Tensor | None = None,
        init: Tensor | None = None,
        state: State | None = None,
    ) -> Tensor:
        """The recurrent layer's output ``[B, T, H]``, from which :meth:`unroll` computes the Q-values."""
        features = self._embed(observation, condition)
        if not isinstance(self.memory, nn.LSTM):
            return self.memory(features)
        lower = autocast_dtype(features) is not None  # nn.LSTM would also lower the precision of the cell
        if lower or (init is not None and not (on_host(init) and not init[:, 1:].any())):
            init = features.new_zeros(features.shape[:2], dtype=torch.bool) if init is None else init
            state = self.initial_state(len(features)) if state is None else state
            return restarting_lstm(self.memory, features, init, state)
        if state is None:
            return self.memory(features)[0]
        if init is not None:
            state = state[0].masked_fill(init[:, :1], 0.0), state[1].masked_fill(init[:, :1], 0.0)
        return self.memory(features, (state[0][None].contiguous(), state[1][None].contiguous()))[0]

    def final_state(self, observation: Tensor, condition: Tensor | None, lengths: Tensor) -> State:
        """State at the end of sequences of different lengths that start from the zero state.

        Args:
            observation: ``[B, T, ...]``; steps after a sequence's end are not read.
            condition: ``[B, T]`` int64, or ``None``.
            lengths: ``[B]`` int64, between 1 and T.

        Returns:
            Hidden and cell state ``[B, H]``.
        """
        features = self._embed(observation, condition)
        packed = pack_padded_sequence(features, lengths.cpu(), batch_first=True, enforce_sorted=False)
        _, (hidden, cell) = self.memory(packed)
        return hidden[0], cell[0]
