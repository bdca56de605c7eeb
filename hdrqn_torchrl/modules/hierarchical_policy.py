"""The controllers of all levels as one policy (Algorithm 1, lines 13 to 17)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch.nn import ModuleList

from hdrqn_torchrl import keys
from hdrqn_torchrl.modules.exploration_checks import check_two_schedules
from hdrqn_torchrl.modules.meta_controller import MetaController
from hdrqn_torchrl.modules.recurrent_state import read_flag
from hdrqn_torchrl.modules.sub_controller import SubController


class HierarchicalPolicy(TensorDictModuleBase):
    """All levels from top to bottom: one decision of the whole agent.

    Args:
        controllers: of the levels, the top one first: one :class:`MetaController` or more, each of which writes the
            subgoal that the next one reads, then the :class:`SubController`, which writes the action.

    Keyword Args:
        read_last_observation: before a new option, advance the sub-controller's state by the observation in
            which the last one ended, so that v2's meta-controller reads it, too. ``False`` is Algorithm 1 as
            written: the state after the last decision. For two levels only.
        init_key: first step of an episode ``[1]`` bool; read if ``read_last_observation``.

    Raises:
        ValueError: if two of them do not fit each other or share an exploration, or there is no state to advance.

    Examples:
        >>> from torchrl.envs import Compose, InitTracker, TransformedEnv
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> from hdrqn_torchrl.transforms import SubgoalTransform
        >>> env, make = MultiGoalGridEnv(num_envs=3), compact_network(8, (8,)).q_network
        >>> meta = MetaController(make(8, num_actions=2), input_keys=["sub_hidden"])
        >>> sub = SubController(make(env.observation_spec["observation"], num_actions=4, num_conditions=2))
        >>> policy = HierarchicalPolicy(meta, sub)
        >>> primers = [controller.make_tensordict_primer() for controller in policy.controllers]
        >>> env = TransformedEnv(env, Compose(InitTracker(), SubgoalTransform(num_subgoals=2), *primers))
        >>> steps = env.rollout(4, policy, break_when_any_done=False)
        >>> steps["subgoal"].shape, steps["action"].shape
        (torch.Size([3, 4]), torch.Size([3, 4]))
    """

    def __init__(
        self,
        *controllers: MetaController | SubController,
        read_last_observation: bool = False,
        init_key: NestedKey = keys.IS_INIT,
    ) -> None:
        super().__init__()
        *uppers, sub_controller = controllers
        if not (isinstance(sub_controller, SubController) and uppers and _all_meta(uppers)):
            raise ValueError(
                "controllers must be one MetaController or more and then one SubController, got "
                f"{[type(each).__name__ for each in controllers]}; give them from top to bottom."
            )
        for index, (upper, lower) in enumerate(pairwise(controllers)):
            _check_fit(upper, lower)
            for other in controllers[index + 1 :]:
                check_two_schedules(other.exploration, upper.exploration)
        if read_last_observation and not sub_controller.network.recurrent:
            raise ValueError("read_last_observation must be False without recurrence: the sub_controller has no state.")
        if read_last_observation and len(uppers) > 1:
            raise ValueError(
                f"read_last_observation must be False with {len(controllers)} controllers, got True; only the state "
                "that the meta_controller of two levels reads can be advanced."
            )
        self.meta_controller, self.sub_controller = uppers[0], sub_controller
        self.middle_controllers = ModuleList(uppers[1:])
        self.read_last_observation, self.init_key = read_last_observation, init_key
        self.in_keys, self.out_keys = _keys_of(self.controllers)
        if read_last_observation and init_key not in self.in_keys:
            self.in_keys.append(init_key)

    @property
    def controllers(self) -> list[TensorDictModuleBase]:
        """Those of all levels, from top to bottom."""
        return [self.meta_controller, *self.middle_controllers, self.sub_controller]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        gate = read_flag(tensordict, self.meta_controller.gate_key)
        if self.read_last_observation:
            meta, sub = self.meta_controller, self.sub_controller
            ended = gate & ~tensordict.get(self.init_key)
            advanced = sub.advance(tensordict, meta.active_subgoal_key)
            for key, value in zip((sub.hidden_key, sub.cell_key), advanced, strict=True):
                tensordict.set(key, torch.where(ended, value, tensordict.get(key)))
        for controller in self.controllers:
            tensordict = controller(tensordict)
        return tensordict


def _all_meta(controllers: Sequence[TensorDictModuleBase]) -> bool:
    return all(isinstance(each, MetaController) for each in controllers)


def _check_fit(upper: TensorDictModuleBase, lower: TensorDictModuleBase) -> None:
    """Refuses a level that does not read what the one above it chooses."""
    chosen, known = upper.network.num_actions, lower.network.num_conditions
    if chosen != known:
        name = "sub_controller" if isinstance(lower, SubController) else "a controller"
        raise ValueError(
            f"{name} must have as many conditions as the meta_controller above it has subgoals, got {known} and "
            f"{chosen}; build its network with num_conditions={chosen}."
        )


def _keys_of(controllers: Sequence[TensorDictModuleBase]) -> tuple[list[NestedKey], list[NestedKey]]:
    """What controllers that act one after the other read from the environment, and what they write."""
    read: list[NestedKey] = []
    written: list[NestedKey] = []
    for each in controllers:
        read += [key for key in each.in_keys if key not in written and key not in read]
        written += each.out_keys
    return read, written
