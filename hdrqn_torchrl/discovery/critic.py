"""The critic of discovered subgoals: a transform that writes the events of each step, and what they attain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol, overload

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs.transforms import Transform

from hdrqn_torchrl import keys
from hdrqn_torchrl.discovery.table import EXPLORE, SubgoalTable
from hdrqn_torchrl.envs import SubgoalSet, Task
from hdrqn_torchrl.transforms.critic import set_where_reset
from hdrqn_torchrl.transforms.entries import set_spec


class Detector(Protocol):
    """What tells the events of a step, a module whose state are buffers."""

    num_tokens: int
    """K."""

    def __call__(self, before: Tensor, action: Tensor, after: Tensor, reward: Tensor) -> Tensor:
        """Tokens of the events between two observations ``[*, ...]``, ``[*, K]`` int64; 0: none."""

    def observe(self, before: Tensor, action: Tensor, after: Tensor) -> None:
        """Learns from steps, until it is ready."""

    @property
    def ready(self) -> bool:
        """Whether it has learned enough: a token then means the same for ever, and before there are none."""

    def name(self, token: int) -> str:
        """An event in words."""


class EventCritic(nn.Module):
    """What an agent takes for its subgoals: a detector of events, and a table of those that count.

    It is a part of the agent's policy, so that its weights have it.

    Args:
        detector: tells the events of a step.
        table: which subgoal each is.

    Examples:
        >>> from hdrqn_torchrl.discovery import ChangeDetector
        >>> critic = EventCritic(ChangeDetector((5,) * 9, num_actions=4, num_dims=2), SubgoalTable(2))
        >>> kept = critic.table.assign({116: 1})
        >>> list(critic.names)
        ['explore', '(1, 1): 3 -> 0', 'free 2']
    """

    detector: Any

    def __init__(self, detector: Detector, table: SubgoalTable) -> None:
        super().__init__()
        self.detector, self.table = detector, table

    @property
    def names(self) -> EventNames:
        """Names of all subgoals as they are now and will be."""
        return EventNames(self)


class EventNames(Sequence[str]):
    """Names of the subgoals of a critic, which change as it finds some."""

    def __init__(self, critic: EventCritic) -> None:
        self._critic = critic

    def __len__(self) -> int:
        return self._critic.table.num_subgoals

    @overload
    def __getitem__(self, index: int) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[str, ...]: ...
    def __getitem__(self, index: int | slice) -> str | tuple[str, ...]:
        if isinstance(index, slice):
            return tuple(self[each] for each in range(*index.indices(len(self))))
        subgoal = range(len(self))[index]
        if subgoal == EXPLORE:
            return "explore"
        events = self._critic.table.tokens_of(subgoal)
        return self._critic.detector.name(events[0]) if events else f"free {subgoal}"


def discovered_set(max_subgoals: int) -> SubgoalSet:
    """The set of subgoals of an agent that finds them itself, before it has found any.

    Examples:
        >>> discovered_set(2).names
        ('explore', 'event 1', 'event 2')
    """
    return SubgoalSet(names=("explore", *(f"event {slot}" for slot in range(1, max_subgoals + 1))))


class DiscoveredSubgoals(Transform):
    """Writes ``events``, ``attained`` and ``available`` in place of whatever the environment says about subgoals.

    1. the detector's tokens of the step go to ``events`` ``[K]``;
    2. ``attained`` ``[G]``: the subgoals that the table has for them;
    3. ``available`` ``[G]``: all that it has, but for those that an episode attains once and has attained; "explore"
       where there are no others. Such a subgoal that is found during an episode can be chosen from the next one on.

    Copies share the critic: what is found in training holds in evaluations, too. (But copies of whole agents do not.)

    Args:
        critic: what events are, and which of them are subgoals. It is not a part of this module.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from hdrqn_torchrl.discovery import DiscoverySettings
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> env = MultiGoalGridEnv(num_envs=2)
        >>> critic, _ = DiscoverySettings(max_subgoals=2).make(env.observation_spec["observation"], num_actions=4)
        >>> TransformedEnv(env, DiscoveredSubgoals(critic)).reset()["available"]  # "explore", as it has found none yet
        tensor([[ True, False, False],
                [ True, False, False]])
    """

    def __init__(self, critic: EventCritic) -> None:
        super().__init__(
            in_keys=[keys.OBSERVATION, keys.EXTRINSIC_REWARD], out_keys=[keys.EVENTS, keys.ATTAINED, keys.AVAILABLE]
        )
        self.__dict__["critic"] = critic

    def __deepcopy__(self, memo: dict[int, Any]) -> DiscoveredSubgoals:
        of_copy = memo.get(id(self.critic))  # where an agent is copied, which has its own
        return DiscoveredSubgoals(self.critic if of_copy is None else of_copy)

    def restated(self, task: Task) -> Task:
        """What is left of a task's statement: its subgoals are those that the agent finds, in no order."""
        return replace(task, subgoals=(discovered_set(self.critic.table.num_subgoals - 1),), ordered=False)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before, action = tensordict.get(keys.OBSERVATION), tensordict.get(keys.ACTION)
        after, reward = next_tensordict.get(keys.OBSERVATION), next_tensordict.get(keys.EXTRINSIC_REWARD)
        table: SubgoalTable = self.critic.table
        events = self.critic.detector(before, action, after, reward)
        attained = table.attained(events)
        spent = ~tensordict.get(keys.AVAILABLE) | attained
        for key, value in (
            (keys.EVENTS, events),
            (keys.ATTAINED, attained),
            (keys.AVAILABLE, table.available(spent)),
        ):
            next_tensordict.set(key, value)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        shape, device = tensordict_reset.batch_size, tensordict_reset.device
        table: SubgoalTable = self.critic.table
        none = torch.zeros((*shape, table.num_subgoals), dtype=torch.bool, device=device)
        fresh = {
            keys.EVENTS: torch.zeros((*shape, self.critic.detector.num_tokens), dtype=torch.int64, device=device),
            keys.ATTAINED: none,
            keys.AVAILABLE: table.available(none),
        }
        return set_where_reset(tensordict, tensordict_reset, fresh)

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._reset(tensordict, tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        shape, device = observation_spec.shape, observation_spec.device
        subgoals, tokens = self.critic.table.num_subgoals, self.critic.detector.num_tokens
        for key in (keys.ATTAINED, keys.AVAILABLE):
            set_spec(observation_spec, key, Binary(shape=(*shape, subgoals), dtype=torch.bool, device=device))
        set_spec(observation_spec, keys.EVENTS, Unbounded((*shape, tokens), dtype=torch.int64, device=device))
        return observation_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise RuntimeError(
            "DiscoveredSubgoals follows episodes and can't be applied to stored data; append it to an environment."
        )
