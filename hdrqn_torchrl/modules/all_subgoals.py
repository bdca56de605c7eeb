"""hDRQNv3's network and policy: one memory of the whole episode, the values of all subgoals on it.

The LSTM reads observation and previous action, not the subgoal, and goes on through the options of an episode. On
its output stand a dueling head for every subgoal (sub level) and one over the subgoals (meta level). One pass gives
all of them, in acting and learning alike.
"""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Categorical, Unbounded
from torchrl.envs.transforms import TensorDictPrimer
from torchrl.modules import recurrent_mode

from hdrqn_torchrl import keys
from hdrqn_torchrl.devices import on_host
from hdrqn_torchrl.modules.controllers import first_state
from hdrqn_torchrl.modules.exploration import EpsilonGreedy, carried_by, choose
from hdrqn_torchrl.modules.exploration_checks import (
    check_chooses_subgoals,
    check_condition,
    check_two_schedules,
    exploration_or_greedy,
)
from hdrqn_torchrl.modules.features import Features
from hdrqn_torchrl.modules.lstm import Gaps, lstm_weights, restarting_lstm
from hdrqn_torchrl.modules.prediction import ObservationPredictor
from hdrqn_torchrl.modules.q_network import ExactLinear, State, dueling
from hdrqn_torchrl.modules.sizes import check_size


class AllSubgoalsNetwork(nn.Module):
    """Q-values of every action for every subgoal, and of every subgoal, from one memory.

    Args:
        features: maps observations to vectors of ``features.out_features``.
        num_actions: A.
        num_subgoals: G.
        hidden_size: H, size of the LSTM.
        head_size: units of the hidden layer of each level's heads.
        joint: whether the meta level, too, trains the memory; ``False``: it only reads it.
        predictor: a second task for the memory; not used in acting.

    Raises:
        ValueError: if a size is not positive.

    Examples:
        >>> from hdrqn_torchrl.modules.features import FullyConnectedFeatures
        >>> network = AllSubgoalsNetwork(FullyConnectedFeatures(6, (8,)), num_actions=4, num_subgoals=2, hidden_size=16)
        >>> observation, previous_action = torch.zeros(3, 5, 6), torch.zeros(3, 5, dtype=torch.int64)
        >>> init, mask = torch.zeros(3, 5, dtype=torch.bool), torch.ones(3, 5, 2, dtype=torch.bool)
        >>> action_value, subgoal_value, memory = network.unroll(observation, previous_action, init, mask)
        >>> action_value.shape, subgoal_value.shape, memory.shape
        (torch.Size([3, 5, 2, 4]), torch.Size([3, 5, 2]), torch.Size([3, 5, 16]))
    """

    _one_hot: Tensor

    def __init__(
        self,
        features: Features,
        *,
        num_actions: int,
        num_subgoals: int,
        hidden_size: int = 128,
        head_size: int = 128,
        joint: bool = True,
        predictor: ObservationPredictor | None = None,
    ) -> None:
        super().__init__()
        for name, value in (("hidden_size", hidden_size), ("head_size", head_size)):
            check_size(name, value, 128)
        check_size("num_actions", num_actions, "the number of the environment's actions")
        check_size("num_subgoals", num_subgoals, "the number of the task's subgoals")
        self.features, self.hidden_size, self.joint = features, hidden_size, joint
        self.predictor = predictor
        self.num_actions, self.num_subgoals = num_actions, num_subgoals
        self.register_buffer("_one_hot", torch.eye(num_actions), persistent=False)
        self.memory = nn.LSTM(features.out_features + num_actions, hidden_size, batch_first=True)
        self.sub_head = _head(hidden_size, head_size, num_subgoals * (1 + num_actions))
        # Which subgoals are left decides which one pays; the memory need not count them.
        self.meta_head = _head(hidden_size + num_subgoals, head_size, 1 + num_subgoals)

    def initial_state(self, *batch: int) -> State:
        """Zero LSTM state, two tensors ``[*batch, H]``."""
        zeros = self._one_hot.new_zeros((*batch, self.hidden_size))
        return zeros, zeros.clone()

    def _inputs(self, observation: Tensor, previous_action: Tensor, init: Tensor) -> list[Tensor]:
        action = self._one_hot[previous_action] * ~init.unsqueeze(-1)  # none at the first step of an episode
        return [self.features(observation), action]

    def _values(self, hidden: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        action_value = dueling(self.sub_head(hidden).unflatten(-1, (self.num_subgoals, -1)))
        remembered = hidden if self.joint else hidden.detach()
        return action_value, dueling(self.meta_head(torch.cat([remembered, mask.to(hidden.dtype)], -1)))

    def step(
        self, observation: Tensor, previous_action: Tensor, init: Tensor, mask: Tensor, state: State
    ) -> tuple[Tensor, Tensor, State]:
        """One decision.

        Args:
            observation: ``[*, ...]``.
            previous_action: ``[*]`` int64; not read where ``init``.
            init: ``[*]`` bool; where set, the state restarts from zero.
            mask: subgoals that can be chosen ``[*, G]`` bool.
            state: LSTM state, two tensors ``[*, H]``.

        Returns:
            Q-values ``[*, G, A]`` and ``[*, G]``, and the state after ``observation``.
        """
        inputs = torch.cat(self._inputs(observation, previous_action, init), -1)
        state = tuple(part.masked_fill(init.unsqueeze(-1), 0.0) for part in state)  # type: ignore[assignment]
        if inputs.ndim == 1:
            advanced = torch.lstm_cell(inputs[None], [part[None] for part in state], *lstm_weights(self.memory))
            hidden, cell = (part[0] for part in advanced)
        else:
            hidden, cell = torch.lstm_cell(inputs, state, *lstm_weights(self.memory))
        return *self._values(hidden, mask), (hidden, cell)

    def unroll(
        self,
        observation: Tensor,
        previous_action: Tensor,
        init: Tensor,
        mask: Tensor,
        state: State | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Q-values along sequences.

        Args:
            observation, previous_action, init, mask: as in :meth:`step`, ``[B, T, ...]``.
            state: LSTM state before the first step, two tensors ``[B, H]``; zero if not given.

        Returns:
            Q-values ``[B, T, G, A]`` and ``[B, T, G]``, and the memory's output ``[B, T, H]`` they were read from.
        """
        state = self.initial_state(len(init)) if state is None else state
        if not on_host(init):
            inputs = torch.cat(self._inputs(observation, previous_action, init), -1)
            memory = restarting_lstm(self.memory, inputs, init, state)
            return *self._values(memory, mask), memory
        gaps = Gaps(init)
        parts = self._inputs(*(gaps.insert(steps) for steps in (observation, previous_action, init)))
        memory = gaps.lstm(self.memory, parts, state)
        action_value, subgoal_value = self._values(memory, gaps.insert(mask))
        return gaps.remove(action_value), gaps.remove(subgoal_value), gaps.remove(memory)


def _head(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(inplace=True), ExactLinear(hidden, outputs))


class AllSubgoalsPolicy(TensorDictModuleBase):
    """Both levels of hDRQNv3 as one TensorDict module.

    Acting takes one step: where an option starts the meta level chooses the subgoal, elsewhere it is kept; the action
    is chosen by the values of that subgoal. Learning (inside ``set_recurrent_mode(True)``) writes the values of all
    steps, subgoals and actions, and the memory's output, from the memory at the first step of a sequence if there is
    one, else from zero.

    Args:
        network: the network.
        sub_exploration: choice of the action; ``None`` is always greedy.
        meta_exploration: choice of the subgoal; ``None`` is always greedy.
        observation_key, previous_action_key, init_key, option_init_key, active_subgoal_key, mask_key: read.
        action_key, subgoal_key, action_value_key, subgoal_value_key: written.
        hidden_key, cell_key: LSTM state ``[H]``.
        sub_exploration_key, meta_exploration_key: what the explorations carry, if anything.

    Raises:
        ValueError: if an exploration is none, both are one, or ``meta_exploration`` can't choose subgoals.

    Examples:
        >>> from torchrl.envs import Compose, InitTracker, TransformedEnv
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import CellFeatures
        >>> from hdrqn_torchrl.transforms import SubgoalTransform
        >>> network = AllSubgoalsNetwork(CellFeatures(5, num_codes=5), num_actions=4, num_subgoals=2, hidden_size=8)
        >>> policy = AllSubgoalsPolicy(network)
        >>> transforms = Compose(InitTracker(), SubgoalTransform(num_subgoals=2), policy.make_tensordict_primer())
        >>> TransformedEnv(MultiGoalGridEnv(num_envs=3), transforms).rollout(4, policy)["action"].shape
        torch.Size([3, 4])
    """

    def __init__(
        self,
        network: AllSubgoalsNetwork,
        sub_exploration: EpsilonGreedy | None = None,
        meta_exploration: EpsilonGreedy | None = None,
        *,
        observation_key: NestedKey = keys.OBSERVATION,
        previous_action_key: NestedKey = keys.PREVIOUS_ACTION,
        init_key: NestedKey = keys.IS_INIT,
        option_init_key: NestedKey = keys.OPTION_INIT,
        active_subgoal_key: NestedKey = keys.ACTIVE_SUBGOAL,
        mask_key: NestedKey = keys.SUBGOAL_MASK,
        action_key: NestedKey = keys.ACTION,
        subgoal_key: NestedKey = keys.SUBGOAL,
        action_value_key: NestedKey = keys.ACTION_VALUE,
        subgoal_value_key: NestedKey = keys.SUBGOAL_VALUE,
        hidden_key: NestedKey = keys.MEMORY_HIDDEN,
        cell_key: NestedKey = keys.MEMORY_CELL,
        sub_exploration_key: NestedKey = keys.ACTION_EXPLORATION,
        meta_exploration_key: NestedKey = keys.SUBGOAL_EXPLORATION,
    ) -> None:
        super().__init__()
        self.network = network
        self.sub_exploration = exploration_or_greedy(sub_exploration, "sub_exploration")
        self.meta_exploration = exploration_or_greedy(meta_exploration, "meta_exploration")
        check_two_schedules(self.sub_exploration, self.meta_exploration)
        check_condition(self.meta_exploration, "meta_exploration")
        check_chooses_subgoals(self.meta_exploration, "meta_exploration")
        self.sub_exploration.set_num_subgoals(network.num_subgoals)
        self.observation_key, self.previous_action_key, self.init_key = observation_key, previous_action_key, init_key
        self.option_init_key, self.active_subgoal_key, self.mask_key = option_init_key, active_subgoal_key, mask_key
        self.action_key, self.subgoal_key = action_key, subgoal_key
        self.action_value_key, self.subgoal_value_key = action_value_key, subgoal_value_key
        self.hidden_key, self.cell_key = hidden_key, cell_key
        self.sub_exploration_key, self.meta_exploration_key = sub_exploration_key, meta_exploration_key
        self.writes_values = False
        """Whether acting, too, writes the Q-values that it chose by; for those who watch."""
        self.state_keys: list[NestedKey] = [hidden_key, cell_key]
        self._carried = {
            **carried_by(self.sub_exploration, sub_exploration_key),
            **carried_by(self.meta_exploration, meta_exploration_key),
        }
        carried = [*self.state_keys, previous_action_key, *self._carried]
        self.in_keys = [observation_key, init_key, option_init_key, active_subgoal_key, mask_key, *carried]
        self.out_keys = [subgoal_key, action_key, *(_next(key) for key in carried)]

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Puts an empty memory into every reset."""
        state = Unbounded(shape=(self.network.hidden_size,))
        carried = {self.hidden_key: state, self.cell_key: state.clone()}
        carried[self.previous_action_key] = Categorical(self.network.num_actions, shape=(), dtype=torch.int64)
        return TensorDictPrimer({**carried, **self._carried}, expand_specs=True)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        read = (self.observation_key, self.previous_action_key, self.init_key, self.mask_key)
        observation, previous_action, init, mask = (tensordict.get(key) for key in read)
        init = init.squeeze(-1)
        if recurrent_mode():
            state = first_state(tensordict, self.state_keys)
            values = self.network.unroll(observation, previous_action, init, mask, state)
            written = (self.action_value_key, self.subgoal_value_key, self.hidden_key)
            for key, value in zip(written, values, strict=True):
                tensordict.set(key, value)
            return tensordict
        state = tensordict.get(self.hidden_key), tensordict.get(self.cell_key)
        action_value, subgoal_value, (hidden, cell) = self.network.step(observation, previous_action, init, mask, state)
        starts = tensordict.get(self.option_init_key).squeeze(-1)
        meta, key = self.meta_exploration, self.meta_exploration_key
        chosen = choose(meta, subgoal_value, tensordict, key, mask=mask, due=starts)
        subgoal = torch.where(starts, chosen, tensordict.get(self.active_subgoal_key))
        wanted = values_of(action_value, subgoal)
        sub, key = self.sub_exploration, self.sub_exploration_key
        action = choose(sub, wanted, tensordict, key, condition=subgoal, starts=starts)
        if self.writes_values:
            tensordict.set(self.subgoal_value_key, subgoal_value).set(self.action_value_key, wanted)
        tensordict.set(self.subgoal_key, subgoal).set(self.action_key, action)
        for key, value in ((self.hidden_key, hidden), (self.cell_key, cell), (self.previous_action_key, action)):
            tensordict.set(_next(key), value)
        return tensordict


def values_of(action_value: Tensor, subgoal: Tensor) -> Tensor:
    """The values ``[*, A]`` of one subgoal ``[*]`` out of all ``[*, G, A]``."""
    index = subgoal[..., None, None].expand(*subgoal.shape, 1, action_value.shape[-1])
    return action_value.gather(-2, index).squeeze(-2)


def _next(key: NestedKey) -> tuple[str, ...]:
    return ("next", *((key,) if isinstance(key, str) else key))
