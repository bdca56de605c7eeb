"""Subgoals of a Gymnasium environment: what a user says about them, and what becomes of it in each step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from hdrqn_torchrl.envs.findings import ReturnError
from hdrqn_torchrl.envs.gym.returned import truths_of
from hdrqn_torchrl.envs.task import SubgoalSet

Flags = NDArray[np.bool_]


class Subgoals:
    """A set of subgoals of a Gymnasium environment, for subclasses to fill in.

    A subgoal is attained in the step in which its condition becomes true, whichever one the agent pursues.

    Attributes:
        names: of the subgoals.
        prefix: of their entries; empty for the farthest set, the only one that agents of two levels pursue.
        repeatable: whether a subgoal can be attained more than once in an episode; one answer for each, or for all.

    Every world has a copy of its own, so that a set may keep something from step to step. If the environment has
    ``state_dict`` and ``load_state_dict``, such a set needs them, too, for resumed trainings.

    Examples:
        A key to pick up, then a door to open, in MiniGrid's DoorKey:

        >>> class KeyAndDoor(Subgoals):
        ...     names = ("key", "door")
        ...
        ...     def conditions(self, env, before, after, info):
        ...         world = env.unwrapped
        ...         doors = [each for each in world.grid.grid if each is not None and each.type == "door"]
        ...         return world.carrying is not None, doors[0].is_open
        >>> len(KeyAndDoor().names)
        2
    """

    names: Sequence[str] = ()
    prefix: str = ""
    repeatable: bool | Sequence[bool] = False

    def conditions(self, env: gymnasium.Env | None, before: Any, after: Any, info: Mapping[str, Any]) -> Sequence[bool]:
        """Which subgoals' conditions hold after a step, in the order of their names.

        Args:
            env: one world; ``None`` where worlds cannot be looked into (EnvPool, vectors that were not made here).
            before: the observation before the step, as the environment returned it; ``None`` at a reset.
            after: the observation after it.
            info: as returned with it. After a step it also has ``reward``, ``terminated`` and ``truncated``, unless the
                environment writes entries of these names itself.
        """
        raise NotImplementedError(f"{type(self).__name__} must say which subgoals hold: define conditions(...).")

    def available(self, env: gymnasium.Env | None, attained: Flags) -> Sequence[bool] | Flags:
        """Which subgoals are worth choosing now.

        Args:
            env: as in :meth:`conditions`.
            attained: which ones were attained in this episode.

        Returns:
            By default those that can still be attained.
        """
        return ~attained | np.asarray(self.repeatable, np.bool_)

    @property
    def stated(self) -> SubgoalSet:
        """As a task states it."""
        return SubgoalSet(names=tuple(self.names), prefix=self.prefix, repeatable=bool(np.any(self.repeatable)))


class SubgoalRecord:
    """What one world has attained in the episode in progress.

    Args:
        subgoals: one set.
        env: the world; ``None`` if it cannot be looked into.
    """

    def __init__(self, subgoals: Subgoals, env: gymnasium.Env | None) -> None:
        self.subgoals, self.env = deepcopy(subgoals), env
        self._held = self._attained = np.zeros(len(subgoals.names), np.bool_)
        self._keys = subgoals.stated.keys
        self._steps = 0  # since the episode began, or was brought back
        self._rules = {
            method: f"what subgoals.{method} returns, one for each of the names {list(subgoals.names)},"
            for method in ("conditions", "available")
        }

    def begin(self, observation: Any, info: Mapping[str, Any]) -> dict[str, Flags]:
        """Entries at the start of an episode: what holds already is not attained."""
        self._held = self._conditions(None, observation, info)
        self._attained = np.zeros_like(self._held)
        return self._entries(np.zeros_like(self._held))

    def step(self, before: Any, after: Any, info: Mapping[str, Any]) -> dict[str, Flags]:
        """Entries after a step."""
        holds = self._conditions(before, after, info)
        attained = holds & ~self._held & (~self._attained | np.asarray(self.subgoals.repeatable, np.bool_))
        self._held, self._attained = holds, self._attained | attained
        return self._entries(attained)

    def state_dict(self) -> dict[str, Any]:
        """What holds and what was attained, as plain data; and what the set itself keeps, if it says so."""
        own = getattr(self.subgoals, "state_dict", None)
        kept = {} if own is None else {"own": own()}
        return {"held": self._held.tolist(), "attained": self._attained.tolist(), **kept}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self._held, self._attained = (np.asarray(state[name], np.bool_) for name in ("held", "attained"))
        if "own" in state:
            self.subgoals.load_state_dict(state["own"])  # type: ignore[attr-defined]

    def _conditions(self, before: Any, after: Any, info: Mapping[str, Any]) -> Flags:
        self._steps = 0 if before is None else self._steps + 1
        try:
            found = self.subgoals.conditions(self.env, before, after, info)
        except Exception as error:
            raise self._failure("conditions", error) from error
        return self._flags("conditions", found)

    def _entries(self, attained: Flags) -> dict[str, Flags]:
        try:
            found = self.subgoals.available(self.env, self._attained)
        except Exception as error:
            raise self._failure("available", error) from error
        available = self._flags("available", found)
        return {self._keys.attained: attained, self._keys.available: available}

    def _failure(self, method: str, error: Exception) -> ReturnError:
        """What to say of an error in a user's own method."""
        remedy = ""
        if not self._steps and "NoneType" in str(error) and self.env is not None:
            remedy = "; before is None at a reset: a condition that compares with it does not hold then"
        elif isinstance(error, AttributeError):
            if self.env is None:
                remedy = "; env is None for EnvPool and for vectors made elsewhere: use before, after and info"
            elif error.obj is self.env is not self.env.unwrapped and hasattr(self.env.unwrapped, error.name or ""):
                remedy = f"; env is what wrappers show of it: use env.unwrapped.{error.name}"
        own = f"{type(self.subgoals).__name__} ({', '.join(self.subgoals.names)})"
        return ReturnError(
            f"subgoals.{method} of {own} must not fail, got {type(error).__name__}: {error}, {self._steps} steps into "
            f"an episode{remedy}."
        )

    def _flags(self, method: str, found: Sequence[bool] | Flags) -> Flags:
        return truths_of(found, len(self._held), self._rules[method])
