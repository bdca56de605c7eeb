"""A level that chooses subgoals, as a TensorDict module (Algorithm 1, line 15); its paths are the sub-controller's."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.transforms import TensorDictPrimer
from torchrl.modules import recurrent_mode

from hdrqn_torchrl import keys
from hdrqn_torchrl.keys import OptionKeys
from hdrqn_torchrl.modules.exploration import EpsilonGreedy, carried_by, choose
from hdrqn_torchrl.modules.exploration_checks import (
    check_chooses_subgoals,
    check_condition,
    exploration_or_greedy,
)
from hdrqn_torchrl.modules.q_network import QNetwork
from hdrqn_torchrl.modules.recurrent_state import first_state, state_primer


class MetaController(TensorDictModuleBase):
    r"""Chooses the subgoal where an option starts: :math:`Q^M(\hat{o}, g)`.

    Elsewhere subgoal and LSTM state are kept. What it reads makes the version: the observation (v1,
    ``input_keys=["observation"]``) or the state of the level below at the end of the last option (v2,
    ``input_keys=["sub_hidden"]``, ``["sub_cell"]`` or both).

    Below another level that chooses subgoals, it reads which one is pursued (``condition_key``), and its state
    restarts from zero where that level chose another (``init_key``).

    Args:
        network: Q-network over subgoals, with ``num_conditions`` = number of subgoals of the level above; 0 at the top.
        exploration: epsilon-greedy choice; ``None`` is always greedy.
        input_keys: entries read, concatenated along the last dimension if several.
        mask_key: subgoals that may be chosen ``[G]`` bool; ``None``: all of them.
        condition_key: the subgoal of the level above in force ``[]`` int64; ``None`` at the top.
        init_key: where the state restarts ``[1]`` bool: ``option_init`` of the level above. It must be set only where
            the gate is. ``None`` at the top.
        subgoal_key: the choice.
        gate_key: where an option starts ``[1]`` bool.
        active_subgoal_key: the subgoal to keep elsewhere.
        action_value_key: Q-values, written in learning.
        hidden_key, cell_key: LSTM state ``[H]``.
        exploration_key: what the exploration carries from option to option, if anything.
        option_keys: entries of the options of the level above: where they end, and what became of them, on which
            ``exploration`` may depend.
        upper_option_keys: those of the level above that one, whose options end these; ``None``: there is none.
        return_key, steps_key: what its own options earned, and how long they took; read in learning.

    Raises:
        ValueError: if ``network`` and ``condition_key`` do not fit, nothing is read, or ``exploration`` repeats its
            choices.

    Examples:
        >>> from tensordict import TensorDict
        >>> from hdrqn_torchrl.modules import FullyConnectedFeatures
        >>> network = QNetwork(FullyConnectedFeatures(8, (8,)), num_actions=2, hidden_size=8)
        >>> meta = MetaController(network, input_keys=["sub_hidden"], mask_key=None)
        >>> td = TensorDict(sub_hidden=torch.zeros(3, 8), active_subgoal=torch.ones(3, dtype=torch.int64), batch_size=3)
        >>> td["option_init"] = torch.tensor([[True], [False], [False]])
        >>> td["meta_hidden"] = td["meta_cell"] = torch.zeros(3, 8)
        >>> meta(td)["subgoal"][1:]
        tensor([1, 1])
    """

    def __init__(
        self,
        network: QNetwork,
        exploration: EpsilonGreedy | None = None,
        *,
        input_keys: Sequence[NestedKey] = (keys.OBSERVATION,),
        mask_key: NestedKey | None = keys.SUBGOAL_MASK,
        condition_key: NestedKey | None = None,
        init_key: NestedKey | None = None,
        subgoal_key: NestedKey = keys.SUBGOAL,
        gate_key: NestedKey = keys.OPTION_INIT,
        active_subgoal_key: NestedKey = keys.ACTIVE_SUBGOAL,
        action_value_key: NestedKey = keys.SUBGOAL_VALUE,
        hidden_key: NestedKey = keys.META_HIDDEN,
        cell_key: NestedKey = keys.META_CELL,
        exploration_key: NestedKey = keys.SUBGOAL_EXPLORATION,
        option_keys: OptionKeys = OptionKeys(),  # noqa: B008 (frozen)
        upper_option_keys: OptionKeys | None = None,
        return_key: NestedKey = keys.OPTION_RETURN,
        steps_key: NestedKey = keys.OPTION_STEPS,
    ) -> None:
        super().__init__()
        if not input_keys or isinstance(input_keys, str):
            raise ValueError(
                f"input_keys must be a list of at least one entry, got {input_keys!r}; v1 reads ['observation']."
            )
        if not (condition_key is None) == (init_key is None) == (network.num_conditions == 0):
            raise ValueError(
                f"condition_key and init_key must be None exactly when the network has no condition, got "
                f"condition_key={condition_key!r}, init_key={init_key!r} and num_conditions={network.num_conditions}; "
                "only below another level that chooses subgoals there is one to read."
            )
        self.network, self.exploration = network, exploration_or_greedy(exploration, "exploration")
        if condition_key is None:
            check_condition(self.exploration, "exploration")
        else:
            self.exploration.set_num_subgoals(network.num_conditions, names=option_keys, upper_names=upper_option_keys)
        check_chooses_subgoals(self.exploration, "exploration")
        self.input_keys, self.mask_key, self.subgoal_key = list(input_keys), mask_key, subgoal_key
        self.condition_key, self.init_key = condition_key, init_key
        self.gate_key, self.active_subgoal_key = gate_key, active_subgoal_key
        self.action_value_key, self.hidden_key, self.cell_key = action_value_key, hidden_key, cell_key
        self.exploration_key, self.option_keys = exploration_key, option_keys
        self.return_key, self.steps_key = return_key, steps_key
        self.writes_values = False
        """Whether acting, too, writes its Q-values; for those who watch."""
        self.state_keys: list[NestedKey] = [hidden_key, cell_key] if network.recurrent else []
        self._carried = carried_by(self.exploration, exploration_key)
        self.exploration_keys: list[NestedKey] = list(self._carried)
        given = [key for key in (mask_key, condition_key, init_key) if key is not None]
        self.learning_keys = [*self.input_keys, *given, *self.state_keys]
        """What it reads of the sequences that it learns from."""
        self.in_keys = [gate_key, active_subgoal_key, *self.exploration_keys, *self.learning_keys]
        self.out_keys = [subgoal_key, *(keys.next_key(key) for key in (*self.state_keys, *self.exploration_keys))]

    @property
    def loss_keys(self) -> dict[str, NestedKey | None]:
        """Where :class:`~hdrqn_torchrl.objectives.RecurrentDQNLoss` finds what this level learns from.

        Below another level its sequences end where the options of that one do.
        """
        above = self.option_keys
        ends = {"done": above.option_done, "terminated": above.option_terminated, "init": self.init_key}
        return {
            **({} if self.condition_key is None else ends),
            "action": self.subgoal_key,
            "action_value": self.action_value_key,
            "action_mask": self.mask_key,
            "reward": self.return_key,
            "steps": self.steps_key,
        }

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Puts the zero LSTM state into every reset; TorchRL finds this method by itself."""
        return state_primer(self.network, self.hidden_key, self.cell_key, self._carried)

    def _inputs(self, tensordict: TensorDictBase) -> Tensor:
        inputs = [tensordict.get(key) for key in self.input_keys]
        return inputs[0] if len(inputs) == 1 else torch.cat(inputs, -1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        inputs = self._inputs(tensordict)
        condition = None if self.condition_key is None else tensordict.get(self.condition_key)
        init = None if self.init_key is None else tensordict.get(self.init_key)
        if recurrent_mode():
            state = first_state(tensordict, self.state_keys)
            starts = None if init is None else init.squeeze(-1)
            return tensordict.set(self.action_value_key, self.network.unroll(inputs, condition, starts, state))
        gate = tensordict.get(self.gate_key)
        if self.network.recurrent:
            state = tensordict.get(self.hidden_key), tensordict.get(self.cell_key)
            if init is not None:
                state = state[0].masked_fill(init, 0.0), state[1].masked_fill(init, 0.0)
            value, advanced = self.network.step(inputs, condition, state)
            for key, new, old in zip((self.hidden_key, self.cell_key), advanced, state, strict=True):
                tensordict.set(keys.next_key(key), torch.where(gate, new, old))
        else:
            value = self.network.evaluate(inputs, condition)
        mask = None if self.mask_key is None else tensordict.get(self.mask_key)
        if self.writes_values:
            tensordict.set(self.action_value_key, value)
        due = gate.squeeze(-1)
        chosen = choose(
            self.exploration,
            value,
            tensordict,
            self.exploration_key,
            mask=mask,
            condition=condition,
            starts=None if init is None else init.squeeze(-1),
            due=due,
        )
        return tensordict.set(self.subgoal_key, torch.where(due, chosen, tensordict.get(self.active_subgoal_key)))
