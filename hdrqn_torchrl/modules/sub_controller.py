"""The level that acts, as a TensorDict module (Algorithm 1, line 17).

A controller has two paths through the same parameters. Acting (the default) takes one step from the LSTM
state in the tensordict. Learning (inside ``set_recurrent_mode(True)``, which every TorchRL loss enters)
unrolls whole sequences ``[B, T]``, from the LSTM state at their first step if the tensordict has one, else from
zero. Each is one ``TensorDictModuleBase`` and not a chain
of TorchRL's modules because such a chain costs several times the arithmetic of a small network.
"""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.transforms import TensorDictPrimer
from torchrl.modules import recurrent_mode

from hdrqn_torchrl import keys
from hdrqn_torchrl.keys import OptionKeys
from hdrqn_torchrl.modules.exploration import EpsilonGreedy, carried_by, choose
from hdrqn_torchrl.modules.exploration_checks import (
    check_condition,
    exploration_or_greedy,
)
from hdrqn_torchrl.modules.q_network import QNetwork, State
from hdrqn_torchrl.modules.recurrent_state import first_state, read_flag, state_primer


class SubController(TensorDictModuleBase):
    """Chooses the primitive action from observation and subgoal: Q^S({o, g}, a).

    Its LSTM state restarts from zero where ``init_key`` is set: at each option for a hierarchical agent, at
    each episode for a flat one (``subgoal_key=None, init_key="is_init"``), in acting and learning alike.

    Args:
        network: Q-network with ``num_conditions`` = number of subgoals (0 for a flat agent).
        exploration: epsilon-greedy choice; ``None`` is always greedy.
        observation_key, action_key, action_value_key: as named.
        subgoal_key: the subgoal in force, or ``None`` for a flat agent.
        init_key: where the state restarts.
        hidden_key, cell_key: LSTM state ``[H]``.
        exploration_key: what the exploration carries, if anything.
        mask_key: actions that can be chosen ``[A]`` bool; ``None``: all of them.
        option_keys: entries of the options that it pursues: what they are paid, where they end, and what became of
            them, on which ``exploration`` may depend.
        upper_option_keys: those of the options that the level above pursues, which end these; ``None``: it pursues the
            task.

    Raises:
        ValueError: if network or ``exploration`` do not fit a flat or hierarchical agent.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from hdrqn_torchrl.modules import CellFeatures
        >>> network = QNetwork(CellFeatures(5, num_codes=5), num_actions=4, hidden_size=8, num_conditions=2)
        >>> sub = SubController(network)
        >>> td = TensorDict(observation=torch.zeros(3, 5, 5, dtype=torch.uint8), batch_size=3)
        >>> td["subgoal"], td["option_init"] = torch.tensor([0, 1, 1]), torch.ones(3, 1, dtype=torch.bool)
        >>> td["sub_hidden"] = td["sub_cell"] = torch.zeros(3, 8)
        >>> sub(td)["action"].shape
        torch.Size([3])
    """

    def __init__(
        self,
        network: QNetwork,
        exploration: EpsilonGreedy | None = None,
        *,
        observation_key: NestedKey = keys.OBSERVATION,
        subgoal_key: NestedKey | None = keys.SUBGOAL,
        init_key: NestedKey = keys.OPTION_INIT,
        action_key: NestedKey = keys.ACTION,
        action_value_key: NestedKey = keys.ACTION_VALUE,
        hidden_key: NestedKey = keys.SUB_HIDDEN,
        cell_key: NestedKey = keys.SUB_CELL,
        exploration_key: NestedKey = keys.ACTION_EXPLORATION,
        mask_key: NestedKey | None = None,
        option_keys: OptionKeys = OptionKeys(),  # noqa: B008 (frozen)
        upper_option_keys: OptionKeys | None = None,
    ) -> None:
        super().__init__()
        if (subgoal_key is None) != (network.num_conditions == 0):
            raise ValueError(
                f"subgoal_key must be None exactly when the network has no condition, got subgoal_key={subgoal_key!r} "
                f"and num_conditions={network.num_conditions}; set num_conditions to the number of subgoals."
            )
        self.network, self.exploration = network, exploration_or_greedy(exploration, "exploration")
        if subgoal_key is None:
            check_condition(self.exploration, "exploration")
        else:
            self.exploration.set_num_subgoals(network.num_conditions, names=option_keys, upper_names=upper_option_keys)
        self.observation_key, self.subgoal_key, self.init_key = observation_key, subgoal_key, init_key
        self.action_key, self.action_value_key = action_key, action_value_key
        self.hidden_key, self.cell_key, self.exploration_key = hidden_key, cell_key, exploration_key
        self.mask_key, self.option_keys = mask_key, option_keys
        self.writes_values = False
        """Whether acting, too, writes its Q-values; for those who watch."""
        self.in_keys = [observation_key, *(key for key in (subgoal_key, mask_key) if key is not None), init_key]
        self.state_keys: list[NestedKey] = [hidden_key, cell_key] if network.recurrent else []
        self.exploration_keys: list[NestedKey] = list(carried_by(self.exploration, exploration_key))
        carried = [*self.state_keys, *self.exploration_keys]
        self.in_keys += carried
        self.out_keys = [action_key, *(keys.next_key(key) for key in carried)]

    @property
    def loss_keys(self) -> dict[str, NestedKey | None]:
        """Where :class:`~hdrqn_torchrl.objectives.RecurrentDQNLoss` finds what this level learns from."""
        of = self.option_keys
        ends = {"reward": of.intrinsic_reward, "done": of.option_done, "terminated": of.option_terminated}
        return {
            **({} if self.subgoal_key is None else ends),
            "action": self.action_key,
            "action_value": self.action_value_key,
            "action_mask": self.mask_key,
            "init": self.init_key,
            "observation": self.observation_key,
            "memory": self.hidden_key,
        }

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Puts the zero LSTM state into every reset; TorchRL finds this method by itself."""
        return state_primer(
            self.network, self.hidden_key, self.cell_key, carried_by(self.exploration, self.exploration_key)
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation = tensordict.get(self.observation_key)
        subgoal = None if self.subgoal_key is None else tensordict.get(self.subgoal_key)
        init = read_flag(tensordict, self.init_key)  # [*batch, 1]
        if recurrent_mode():
            state = first_state(tensordict, self.state_keys)
            memory = self.network.remember(observation, subgoal, init.squeeze(-1), state)
            if self.network.predictor is not None:
                tensordict.set(self.hidden_key, memory)
            return tensordict.set(self.action_value_key, self.network.head(memory))
        if not self.network.recurrent:
            return tensordict.set(
                self.action_key, self._choose(self.network.evaluate(observation, subgoal), tensordict)
            )
        hidden = tensordict.get(self.hidden_key).masked_fill(init, 0.0)
        cell = tensordict.get(self.cell_key).masked_fill(init, 0.0)
        value, (hidden, cell) = self.network.step(observation, subgoal, (hidden, cell))
        tensordict.set(self.action_key, self._choose(value, tensordict))
        tensordict.set(keys.next_key(self.hidden_key), hidden)
        return tensordict.set(keys.next_key(self.cell_key), cell)

    def _choose(self, value: Tensor, tensordict: TensorDictBase) -> Tensor:
        subgoal = None if self.subgoal_key is None else tensordict.get(self.subgoal_key)
        starts = tensordict.get(self.init_key).squeeze(-1)
        mask = None if self.mask_key is None else tensordict.get(self.mask_key)
        if self.writes_values:
            tensordict.set(self.action_value_key, value)
        return choose(
            self.exploration, value, tensordict, self.exploration_key, mask=mask, condition=subgoal, starts=starts
        )

    def advance(self, tensordict: TensorDictBase, subgoal_key: NestedKey = keys.ACTIVE_SUBGOAL) -> State:
        """LSTM state after one more observation, without a decision.

        Args:
            tensordict: holds observation and LSTM state.
            subgoal_key: the subgoal that was pursued.

        Returns:
            Hidden and cell state ``[*batch, H]``.
        """
        state = tensordict.get(self.hidden_key), tensordict.get(self.cell_key)
        subgoal = None if self.subgoal_key is None else tensordict.get(subgoal_key)
        return self.network.step(tensordict.get(self.observation_key), subgoal, state)[1]
