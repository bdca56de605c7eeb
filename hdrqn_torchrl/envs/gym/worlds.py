"""One world of a Gymnasium environment as agents see it: what it shows, its subgoals, its success."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from numpy.typing import NDArray

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.findings import ReturnError
from hdrqn_torchrl.envs.gym.encoder import Encoder
from hdrqn_torchrl.envs.gym.returned import (
    begun,
    check_readable,
    info_of,
    number_of,
    parts_of,
    shown,
    truth_of,
    truths_of,
)
from hdrqn_torchrl.envs.gym.subgoals import SubgoalRecord, Subgoals

Entries = dict[str, NDArray]
_BOOL: Any = np.bool_  # which Gymnasium's annotations leave out
Stepped = tuple[Entries, float, bool, bool]
Rule = Callable[[float, Mapping[str, Any]], float]
MOST_ACTIONS = 10_000
"""A longer episode cannot be brought back by its actions: they would be kept, and repeated, without bound."""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How the entries of a step are read from what a Gymnasium environment returns.

    Args:
        encoder: of observations.
        subgoals: sets of subgoals, from near to far.
        success: name of an entry of ``info``, or a function of (reward, info); ``None``: nothing is known of it.
        hazard: the same for what is to be avoided.
        reward: the same for a reward in place of the environment's own.
        masked_actions: the agent's actions by their places among the environment's, if ``info["action_mask"]`` tells
            which ones of the environment's can be chosen; empty if it does not.
        mask_entry: of a ``Dict`` observation that tells it in place of ``info``; ``None``: none does.
        num_actions: how many actions the environment has.
    """

    encoder: Encoder
    subgoals: tuple[Subgoals, ...] = ()
    success: str | Rule | None = None
    hazard: str | Rule | None = None
    reward: str | Rule | None = None
    masked_actions: tuple[int, ...] = ()
    mask_entry: str | None = None
    num_actions: int = 0

    @cached_property
    def space(self) -> spaces.Dict:
        """Of the entries of one world."""
        sizes = {
            each.stated.keys.of(key): len(each.names) for each in self.subgoals for key in ("attained", "available")
        }
        sizes |= {
            key: 1 for key, rule in ((keys.SUCCESS, self.success), (keys.HAZARD, self.hazard)) if rule is not None
        }
        sizes |= {keys.ACTION_MASK: len(self.masked_actions)} if self.masked_actions else {}
        flags = {key: spaces.Box(0, 1, (size,), _BOOL) for key, size in sizes.items()}
        return spaces.Dict({keys.OBSERVATION: self.encoder.space, **flags})


class World:
    """The entries of one world, step by step.

    Args:
        reading: how they are read.
        env: the world; ``None`` if it cannot be looked into.
    """

    def __init__(self, reading: Reading, env: gymnasium.Env | None = None) -> None:
        self.reading = reading
        self._records = [SubgoalRecord(each, env) for each in reading.subgoals]
        self.shown: Any = None
        """The last observation, as the environment returned it."""
        self._before: Any = None  # the same, for subgoals: an environment may write the next one into its place

    def begin(self, observation: Any, info: Mapping[str, Any]) -> Entries:
        """Entries at the start of an episode."""
        entries = self._entries(observation, info_of(info, "reset"), over=False)
        for record in self._records:
            entries |= record.begin(observation, info)
        self._keep(observation)
        no = np.zeros(1, np.bool_)
        return entries | {key: no for key in (keys.SUCCESS, keys.HAZARD) if key in self.reading.space.spaces}

    def step(self, observation: Any, reward: Any, terminated: Any, truncated: Any, info: Any) -> Stepped:
        """Entries after a step, its reward, and whether the episode terminated or was truncated, as returned."""
        reward, info = number_of(reward, "reward"), info_of(info, "step")
        terminated, truncated = truth_of(terminated, "terminated"), truth_of(truncated, "truncated")
        told = {"reward": reward, "terminated": terminated, "truncated": truncated, **info}
        entries = self._entries(observation, info, over=terminated or truncated)
        for record in self._records:
            entries |= record.step(self._before, observation, told)
        self._keep(observation)
        for key, rule in ((keys.SUCCESS, self.reading.success), (keys.HAZARD, self.reading.hazard)):
            if rule is not None:
                entries[key] = np.array([truth_of(_applied(rule, reward, told, key), key)])
        if (rule := self.reading.reward) is not None:
            reward = number_of(_applied(rule, reward, told, "reward"), "reward")
        return entries, reward, terminated, truncated

    def subgoals_state(self) -> list[dict[str, Any]]:
        """What was attained so far, as plain data."""
        return [record.state_dict() for record in self._records]

    def go_on(self, shown: Any, subgoals: Sequence[Mapping[str, Any]]) -> Entries:
        """Goes on in the middle of an episode that was left with this observation and :meth:`subgoals_state`."""
        self._keep(shown)
        for record, state in zip(self._records, subgoals, strict=True):
            record.load_state_dict(state)
        return {keys.OBSERVATION: self.reading.encoder.encode(shown)}

    def _keep(self, observation: Any) -> None:
        self.shown = observation
        if self._records:
            self._before = deepcopy(observation)

    def _entries(self, observation: Any, info: Mapping[str, Any], *, over: bool) -> Entries:
        entries: Entries = {keys.OBSERVATION: self.reading.encoder.encode(observation)}
        if (name := self.reading.mask_entry) is not None:
            info = {**info, keys.ACTION_MASK: observation[name]}
        if self.reading.masked_actions:
            entries[keys.ACTION_MASK] = _action_mask(info, self.reading, over=over)
        elif keys.ACTION_MASK in info:
            raise ReturnError(
                "info['action_mask'] must be there at the first reset, too, and was not; an environment either always "
                "tells which actions can be chosen, or never."
            )
        return entries


def _applied(rule: str | Rule, reward: float, info: Mapping[str, Any], name: str) -> Any:
    if not isinstance(rule, str):
        return rule(reward, info)
    if rule not in info:
        raise ValueError(
            f"{name} must name an entry of info after every step, got {rule!r}; info has {sorted(info)}. One that is "
            f"there now and then needs a function: {name}=my_package.function, of (reward, info)."
        )
    return info[rule]


def _action_mask(info: Mapping[str, Any], reading: Reading, *, over: bool) -> NDArray[np.bool_]:
    """Which of the agent's actions can be chosen: at least one, until the episode is over."""
    if (mask := info.get(keys.ACTION_MASK)) is None:
        raise ReturnError(
            f"info['action_mask'] must be there at resets and after every step, info has {sorted(map(str, info))}; an "
            "environment either always tells which actions can be chosen, or never."
        )
    allowed = truths_of(mask, reading.num_actions, "info['action_mask'], one for each action,")
    chosen = allowed[list(reading.masked_actions)]
    if not over and not chosen.any():
        among = "" if len(chosen) == len(allowed) else " (actions=...)"
        raise ReturnError(
            f"info['action_mask'] must allow one of the agent's actions{among} until the episode is over, got "
            f"{shown(mask.tolist() if isinstance(mask, np.ndarray) else mask)}; end the episode where nothing can be "
            "done, or give the agent an action that can be chosen there."
        )
    return chosen


class WorldWrapper(gymnasium.Wrapper):
    """A world of Gymnasium's whose observations are all entries that agents read, and that can be brought back.

    An episode in progress is known by its seed and its actions, up to :data:`MOST_ACTIONS` of them: an environment that
    draws all its random numbers from the generator that ``reset(seed=...)`` seeds comes back if the same is done again.
    One that has ``state_dict`` and ``load_state_dict`` itself, behind no wrappers but those that ``gymnasium.make``
    adds, comes back with these.

    Args:
        env: one world.
        reading: how entries are read.
    """

    def __init__(self, env: gymnasium.Env, reading: Reading) -> None:
        super().__init__(env)
        self.world = World(reading, env)
        self.observation_space = reading.space
        self.entries: Entries = {}
        self._state = EnvState(env) if EnvState.is_offered(env) else None
        self._seed: int | None = None
        self._actions: list[int] | None = []  # None: there were too many
        self.lost = False
        """Whether the last :attr:`moment` could not be brought back."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Entries, dict[str, Any]]:
        """A new episode; see :class:`gymnasium.Env`."""
        observation, info = begun(self.env, seed=seed, options=options)
        self._seed, self._actions = seed, []
        self.entries = self.world.begin(observation, info)
        return self.entries, {}

    def step(self, action: int) -> tuple[Entries, float, bool, bool, dict[str, Any]]:
        """One step; see :class:`gymnasium.Env`. An episode that terminates is not truncated."""
        if self._state is None:
            self._keep(int(action))
        try:
            returned = self.env.step(action)
        except (ValueError, TypeError, AssertionError) as error:
            check_readable(error, "step")
            raise
        self.entries, reward, terminated, truncated = self.world.step(*parts_of(returned, "step"))
        return self.entries, reward, terminated, truncated and not terminated, {}

    def _played_again(self, seed: int, actions: Sequence[int]) -> bool:
        """Whether an episode takes the same actions again; one that goes another way may refuse them."""
        try:
            self.reset(seed=seed)
            for action in actions:
                self.step(action)
        except Exception as error:  # whatever the world raises
            warnings.warn(f"an episode can't be played again as it was: {error!r}.", stacklevel=2)
            self.reset()
            return False
        return True

    def _keep(self, action: int) -> None:
        if self._actions is not None and len(self._actions) < MOST_ACTIONS:
            self._actions.append(action)
        else:
            self._actions = None

    @property
    def moment(self) -> dict[str, Any] | None:
        """What brings the episode in progress back; ``None`` if it is too long for that."""
        if self._state is None:
            if self._actions is None:
                return None
            seed = -1 if self._seed is None else self._seed
            return {"seed": seed, "actions": torch.tensor(self._actions, dtype=torch.int32)}
        shown = self.env.observation_space.to_jsonable([self.world.shown])
        return {"env": self._state.state_dict(), "shown": shown, "subgoals": self.world.subgoals_state()}

    @moment.setter
    def moment(self, moment: Mapping[str, Any]) -> None:
        if self._state is None:
            self.lost = not self._played_again(int(moment["seed"]), moment["actions"].tolist())
            return
        self.reset()
        self._state.load_state_dict(moment["env"])
        shown = self.env.observation_space.from_jsonable(moment["shown"])[0]
        self.entries = self.world.go_on(shown, moment["subgoals"])


class EnvState:
    """The state of an environment that offers one, with the time that the limit around it has counted.

    Args:
        env: one world, behind the wrappers that ``gymnasium.make`` adds.
    """

    def __init__(self, env: gymnasium.Env) -> None:
        self._env: Any = env.unwrapped
        self._limits = [each for each in _wrappers(env) if isinstance(each, TimeLimit)]

    @staticmethod
    def is_offered(env: gymnasium.Env) -> bool:
        """Whether nothing but its state and those wrappers' make up the world."""
        usual = all(isinstance(each, TimeLimit | OrderEnforcing | PassiveEnvChecker) for each in _wrappers(env))
        return usual and all(callable(getattr(env.unwrapped, name, None)) for name in ("state_dict", "load_state_dict"))

    def state_dict(self) -> dict[str, Any]:
        """Plain data and tensors."""
        return {"env": self._env.state_dict(), "steps": [each._elapsed_steps for each in self._limits]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self._env.load_state_dict(state["env"])
        for limit, steps in zip(self._limits, state["steps"], strict=True):
            limit._elapsed_steps = steps


def _wrappers(env: gymnasium.Env) -> Iterator[gymnasium.Wrapper]:
    while isinstance(env, gymnasium.Wrapper):
        yield env
        env = env.env
