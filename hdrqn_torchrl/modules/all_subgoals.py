"""hDRQNv3's policy: all levels choose by the Q-values of one network (:mod:`.all_subgoals_network`)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Categorical, Unbounded
from torchrl.envs.transforms import TensorDictPrimer
from torchrl.modules import recurrent_mode

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.symmetry import Symmetry
from hdrqn_torchrl.modules.all_subgoals_network import AllSubgoalsNetwork
from hdrqn_torchrl.modules.exploration import EpsilonGreedy, carried_by, choose
from hdrqn_torchrl.modules.exploration_checks import (
    check_chooses_subgoals,
    check_condition,
    check_two_schedules,
    exploration_or_greedy,
)
from hdrqn_torchrl.modules.recurrent_state import first_state, read_flag
from hdrqn_torchrl.modules.symmetric_mean import SymmetricMean


class AllSubgoalsPolicy(TensorDictModuleBase):
    """All levels of hDRQNv3 as one TensorDict module.

    In acting, one step goes from the top level down. Where an option of a level starts, the level chooses a subgoal by
    its Q-values for what the level above pursues; elsewhere it keeps its subgoal. The action is chosen by the Q-values
    for the nearest subgoal. In learning (inside ``set_recurrent_mode(True)``), the module writes the Q-values of all
    steps, subgoals and actions, and the output of the memory; sequences start from the stored state of the memory if
    there is one, else from zero.

    Args:
        network: the network.
        sub_exploration: choice of the action; ``None`` is always greedy.
        meta_exploration: choice of the farthest subgoal; ``None`` is always greedy.
        middle_explorations: choice of the nearer subgoals, from near to far; empty: always greedy.
        subgoal_keys: entries of each of the network's sets of subgoals, from near to far.
        observation_key, previous_action_key, init_key: entries that are read.
        action_key, action_value_key: entries that are written.
        hidden_key, cell_key: LSTM state ``[H]``, with ``symmetries`` ``[K * H]`` in acting.
        exploration_key: state that the exploration of actions carries, if any.
        action_mask_key: actions that can be chosen ``[A]`` bool; ``None``: all of them.
        symmetries: ways to turn or mirror worlds; given, acting goes by the mean of Q-values over all of them
            (:class:`~hdrqn_torchrl.modules.symmetric_mean.SymmetricMean`), and its LSTM state is that of K worlds,
            ``[K * H]``.

    Raises:
        ValueError: if an exploration is not an ``EpsilonGreedy``, serves two levels or can't choose subgoals, or if
            their number or that of ``subgoal_keys`` does not fit the network.

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
        middle_explorations: Sequence[EpsilonGreedy] = (),
        subgoal_keys: Sequence[keys.OptionKeys] = (keys.OptionKeys(),),
        observation_key: NestedKey = keys.OBSERVATION,
        previous_action_key: NestedKey = keys.PREVIOUS_ACTION,
        init_key: NestedKey = keys.IS_INIT,
        action_key: NestedKey = keys.ACTION,
        action_value_key: NestedKey = keys.ACTION_VALUE,
        hidden_key: NestedKey = keys.MEMORY_HIDDEN,
        cell_key: NestedKey = keys.MEMORY_CELL,
        exploration_key: NestedKey = keys.ACTION_EXPLORATION,
        action_mask_key: NestedKey | None = None,
        symmetries: Sequence[Symmetry] = (),
    ) -> None:
        super().__init__()
        if len(subgoal_keys) != len(network.num_subgoals):
            raise ValueError(
                f"subgoal_keys must have one item for each of the network's {len(network.num_subgoals)} sets of "
                f"subgoals, got {len(subgoal_keys)}; give them from near to far."
            )
        self.network = network
        self.symmetric_mean = SymmetricMean(symmetries) if symmetries else None
        self.sub_exploration = exploration_or_greedy(sub_exploration, "sub_exploration")
        if subgoal_keys:
            self.meta_exploration = exploration_or_greedy(meta_exploration, "meta_exploration")
        self.middle_explorations = nn.ModuleList(_middle(middle_explorations, len(subgoal_keys) - 1))
        self._check_explorations()
        self.subgoal_keys = tuple(subgoal_keys)
        pursuing = [self.sub_exploration, *self.middle_explorations] if subgoal_keys else []
        above = [*subgoal_keys[1:], None][: len(subgoal_keys)]
        for exploration, number, each, upper in zip(pursuing, network.num_subgoals, subgoal_keys, above, strict=True):
            exploration.set_num_subgoals(number, names=each, upper_names=upper)
        self.observation_key, self.previous_action_key, self.init_key = observation_key, previous_action_key, init_key
        self.action_key, self.action_value_key = action_key, action_value_key
        self.hidden_key, self.cell_key, self.exploration_key = hidden_key, cell_key, exploration_key
        self.writes_values = False
        """Whether acting also writes the Q-values that choices were made by, for watching."""
        self.state_keys: list[NestedKey] = [hidden_key, cell_key]
        self.mask_keys = [each.subgoal_mask for each in subgoal_keys]
        self.action_mask_key = action_mask_key
        self._carried = carried_by(self.sub_exploration, exploration_key)
        for exploration, each in zip(self.subgoal_explorations, subgoal_keys, strict=True):
            self._carried |= carried_by(exploration, each.exploration)
        self.exploration_keys: list[NestedKey] = list(self._carried)
        carried = [*self.state_keys, previous_action_key, *self.exploration_keys]
        books = [key for each in subgoal_keys for key in (each.option_init, each.active_subgoal, each.subgoal_mask)]
        masks = [] if action_mask_key is None else [action_mask_key]
        self.in_keys = [observation_key, init_key, *masks, *books, *carried]
        self.out_keys = [*(each.subgoal for each in subgoal_keys), action_key, *(keys.next_key(key) for key in carried)]

    def _check_explorations(self) -> None:
        explorations = self.subgoal_explorations
        names = [f"middle_explorations[{index}]" for index in range(len(explorations) - 1)] + ["meta_exploration"]
        for index, (name, exploration) in enumerate(zip(names, explorations, strict=False)):
            for other in (self.sub_exploration, *explorations[:index]):
                check_two_schedules(other, exploration)
            if exploration is explorations[-1]:
                check_condition(exploration, name)
            check_chooses_subgoals(exploration, name)
        if not explorations:
            check_condition(self.sub_exploration, "sub_exploration")

    @property
    def subgoal_explorations(self) -> list[EpsilonGreedy]:
        """Explorations of the levels that choose subgoals, from near to far."""
        return [*self.middle_explorations, *([self.meta_exploration] if self.network.num_subgoals else [])]

    @property
    def value_keys(self) -> list[NestedKey]:
        """Entries with the Q-values of each level ``[C, X]``, written in learning."""
        return [self.action_value_key, *(each.subgoal_value for each in self.subgoal_keys)]

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """A transform that adds an empty memory to every reset."""
        worlds = 1 if self.symmetric_mean is None else self.symmetric_mean.number
        state = Unbounded(shape=(worlds * self.network.hidden_size,))
        carried = {self.hidden_key: state, self.cell_key: state.clone()}
        carried[self.previous_action_key] = Categorical(self.network.num_actions, shape=(), dtype=torch.int64)
        return TensorDictPrimer({**carried, **self._carried}, expand_specs=True)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, previous_action = (tensordict.get(key) for key in (self.observation_key, self.previous_action_key))
        init = read_flag(tensordict, self.init_key).squeeze(-1)
        masks = [tensordict.get(key) for key in self.mask_keys]
        if recurrent_mode():
            state = first_state(tensordict, self.state_keys)
            values, memory = self.network.unroll(observation, previous_action, init, masks, state)
            for key, value in zip(self.value_keys, values, strict=True):
                tensordict.set(key, value)
            return tensordict.set(self.hidden_key, memory)
        state = tensordict.get(self.hidden_key), tensordict.get(self.cell_key)
        step = self.network.step if self.symmetric_mean is None else partial(self.symmetric_mean.step, self.network)
        values, (hidden, cell) = step(observation, previous_action, init, masks, state)
        subgoal, starts = self._choose_subgoals(values[1:], masks, tensordict)
        wanted = values[0].squeeze(-2) if subgoal is None else values_of(values[0], subgoal)
        sub, key = self.sub_exploration, self.exploration_key
        allowed = None if self.action_mask_key is None else tensordict.get(self.action_mask_key)
        action = choose(sub, wanted, tensordict, key, mask=allowed, condition=subgoal, starts=starts)
        if self.writes_values:
            tensordict.set(self.action_value_key, wanted)
        tensordict.set(self.action_key, action)
        for key, value in ((self.hidden_key, hidden), (self.cell_key, cell), (self.previous_action_key, action)):
            tensordict.set(keys.next_key(key), value)
        return tensordict

    def _choose_subgoals(
        self, values: Sequence[Tensor], masks: Sequence[Tensor], tensordict: TensorDictBase
    ) -> tuple[Tensor | None, Tensor | None]:
        """Chooses from the top down, each level given the choice of the level above.

        Returns:
            The nearest subgoal, and where its option starts, ``[*]`` each.
        """
        subgoal: Tensor | None = None
        began: Tensor | None = None  # where the level above has just chosen
        levels = list(zip(values, masks, self.subgoal_keys, self.subgoal_explorations, strict=True))
        for value, mask, names, exploration in reversed(levels):
            wanted = value.squeeze(-2) if subgoal is None else values_of(value, subgoal)
            due, key = tensordict.get(names.option_init).squeeze(-1), names.exploration
            choice = choose(exploration, wanted, tensordict, key, mask=mask, condition=subgoal, starts=began, due=due)
            subgoal, began = torch.where(due, choice, tensordict.get(names.active_subgoal)), due
            tensordict.set(names.subgoal, subgoal)
            if self.writes_values:
                tensordict.set(names.subgoal_value, wanted)
        return subgoal, began


def _middle(explorations: Sequence[EpsilonGreedy], number: int) -> list[EpsilonGreedy]:
    """The explorations of the middle levels; greedy ones if none are given."""
    number = max(number, 0)
    given = list(explorations) or [EpsilonGreedy(0.0, 0.0) for _ in range(number)]
    if len(given) != number:
        raise ValueError(
            f"middle_explorations must have one item for each of {number} middle levels, got {len(given)}; give them "
            "from near to far, or none for greedy choices."
        )
    return [exploration_or_greedy(each, f"middle_explorations[{index}]") for index, each in enumerate(given)]


def values_of(action_value: Tensor, subgoal: Tensor) -> Tensor:
    """Selects the values ``[*, A]`` of one subgoal ``[*]`` from those of all ``[*, G, A]``."""
    index = subgoal[..., None, None].expand(*subgoal.shape, 1, action_value.shape[-1])
    return action_value.gather(-2, index).squeeze(-2)
