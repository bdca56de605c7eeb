"""One greedy decision of an agent as a function of tensors: observation and state in, action and state out.

It consists of the agent's own parts. What a training's environment does between two decisions (the option books of
:class:`~hdrqn_torchrl.transforms.SubgoalTransform`, the critic of discovered subgoals, the empty memory at a reset) is
done at the beginning of the next decision.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type
from torchrl.envs.transforms import InitTracker, TensorDictPrimer, Transform

from hdrqn_torchrl import keys
from hdrqn_torchrl.algorithms import Algorithm
from hdrqn_torchrl.discovery import DiscoveredSubgoals
from hdrqn_torchrl.modules import writing_values
from hdrqn_torchrl.transforms import SubgoalTransform

NEXT = "next_"
"""Put before the name of a part of the state in what a decision returns."""
BATCH = 2
"""Rows of the example's tensors; a decision takes any number."""

Book = SubgoalTransform | DiscoveredSubgoals


@dataclass(frozen=True)
class Carried:
    """A part of the state: what one decision leaves for the next.

    Args:
        name: the decision takes it under this name, and returns it under this name after ``"next_"``.
        before: the entry of the step before that it holds.
        after: the entry that it becomes after a decision.
        void: where this entry is set, zero is left; ``None``: nowhere.
    """

    name: str
    before: NestedKey
    after: NestedKey
    void: NestedKey | None = None


class DecisionStep(nn.Module):
    """One greedy decision of all levels, for N worlds side by side.

    ``forward`` takes and returns tensors by name. It takes what the environment shows (:attr:`observed`) and the state
    (:attr:`carried`), which may hold anything where ``is_init`` is set. It returns

    - ``action`` ``[N]``, the one of the largest Q-value, and ``action_value`` ``[N, A]``;
    - for each set of subgoals ``subgoal_value`` ``[N, G]``, and ``option_init`` ``[N, 1]``: whether the last option has
      ended, so that this decision chose a subgoal anew (names have the set's prefix);
    - the state for the next decision, with ``next_`` before each name; ``next_active_subgoal`` is the subgoal that is
      now pursued.

    Args:
        algorithm: the agent.
        env: its environment with the agent's transforms, for shapes.

    Raises:
        ValueError: if the agent has other transforms than option books, critics and primers: what they do between two
            decisions is not known here.

    Examples:
        >>> from hdrqn_torchrl.algorithms import make_hdrqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> env = MultiGoalGridEnv(num_envs=4)
        >>> agent = make_hdrqn(env, compact_network())
        >>> step = DecisionStep(agent, agent.transform(env))
        >>> step.observed
        ['observation', 'is_init', 'attained']
        >>> [part.name for part in step.carried][:3]
        ['active_subgoal', 'subgoal_mask', 'sub_hidden']
        >>> step(step.example())["action"].shape
        torch.Size([2])
    """

    def __init__(self, algorithm: Algorithm, env: EnvBase) -> None:
        super().__init__()
        transforms = list(algorithm.make_transforms().transforms)
        _check_transforms(transforms)
        self.policy, self.levels = algorithm.policy, algorithm.levels
        self._books: list[Book] = [each for each in transforms if isinstance(each, Book)]
        primed = [key for each in transforms if isinstance(each, TensorDictPrimer) for key in each.primers]
        random = {key for part in self.policy.modules() for key in getattr(part, "exploration_keys", ())}
        kept = [key for key in primed if ("next", *_path(key)) in self.policy.out_keys]  # networks may have no memory
        self._memory: list[NestedKey] = [key for key in kept if key not in random]
        memory = [Carried(name_of(key), key, ("next", *_path(key))) for key in self._memory]
        self.carried = [*_carried_by(self._books), *memory]
        """The state."""
        written = [*primed, *(key for book in self._books for key in book.out_keys)]
        read = [keys.OBSERVATION, keys.IS_INIT, *_read_by(self._books), *self.policy.in_keys]
        self.observed: list[NestedKey] = [key for key in dict.fromkeys(read) if key not in written]
        """What the environment shows: entries of what follows a step, or of a reset."""
        self.action_numbers: tuple[int, ...] = getattr(
            env, "action_numbers", tuple(range(env.full_action_spec[keys.ACTION].n))
        )
        """The task's own number of each action, where an agent has only some of them."""
        fake = env.fake_tensordict()
        self._like = {key: fake.get(key)[:1] for key in fake.exclude("next").keys(True, True)}
        self._like |= {key: fake.get(("next", key))[:1] for key in fake.get("next").keys(True, True)}

    @property
    def outputs(self) -> list[NestedKey]:
        """Entries that are returned besides the state."""
        values = [level.value_key for level in self.levels]
        chosen = [level.init_key for level in self.levels if level.init_key is not None]
        return [keys.ACTION, *values, *chosen]

    def example(self) -> dict[str, Tensor]:
        """Inputs of the right shapes and dtypes, as at the beginning of episodes."""
        inputs = {name_of(key): self._zeros(key, BATCH) for key in self.observed}
        inputs[keys.IS_INIT] = torch.ones_like(inputs[keys.IS_INIT])
        return inputs | {part.name: self._zeros(part.before, BATCH) for part in self.carried}

    def forward(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        number = inputs[keys.IS_INIT].shape[0]
        now = self._after_step(inputs, number)
        with set_exploration_type(ExplorationType.DETERMINISTIC), writing_values(self.policy):
            now = self.policy(now)
        state = {NEXT + part.name: _left(now, part) for part in self.carried}
        return {**{name_of(key): now.get(key) for key in self.outputs}, **state}

    def _after_step(self, inputs: Mapping[str, Tensor], number: int) -> TensorDictBase:
        """What the policy reads, ``[N]``: the books after the step that led here, or new ones after a reset."""
        blank = {key: self._zeros(key, number) for key in self._like}
        before = TensorDict(blank | {part.before: inputs[part.name] for part in self.carried}, [number])
        now = TensorDict(blank | {key: inputs[name_of(key)] for key in self.observed}, [number])
        init = now.get(keys.IS_INIT)
        for book in self._books:
            if isinstance(book, SubgoalTransform):
                before.set(book.subgoal_key, before.get(book.active_subgoal_key))
            now = book._step(before, now)
            now = book._reset(now.set("_reset", init), now)
        for key in self._memory:
            kept = before.get(key)
            now.set(key, kept.masked_fill(init.view(number, *[1] * (kept.ndim - 1)), 0))
        return now

    def _zeros(self, key: NestedKey, number: int) -> Tensor:
        like = self._like[key]
        return torch.zeros((number, *like.shape[1:]), dtype=like.dtype)


def name_of(key: NestedKey) -> str:
    """The name under which an entry is taken and returned.

    Examples:
        >>> name_of("observation"), name_of(("agent", "hidden"))
        ('observation', 'agent.hidden')
    """
    return ".".join(_path(key))


def _path(key: NestedKey) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key


def _check_transforms(transforms: Sequence[Transform]) -> None:
    known = (Book, InitTracker, TensorDictPrimer)
    if others := [type(each).__name__ for each in transforms if not isinstance(each, known)]:
        raise ValueError(
            f"the agent's transforms must be those of this project to be exported, got {', '.join(others)} as well; "
            "put what changes observations into the environment, in front of the agent."
        )


def _read_by(books: Sequence[Book]) -> Iterator[NestedKey]:
    """Entries of the environment on which the books' subgoals depend (rewards only pay for them)."""
    for book in books:
        if isinstance(book, SubgoalTransform):
            yield book.attained_key
            yield from [] if book.available_key is None else [book.available_key]
        else:
            yield keys.EXTRINSIC_REWARD


def _carried_by(books: Sequence[Book]) -> Iterator[Carried]:
    """What the books know of the step before."""
    for book in books:
        if isinstance(book, SubgoalTransform):
            yield Carried(name_of(book.active_subgoal_key), book.active_subgoal_key, book.subgoal_key)
            yield Carried(name_of(book.subgoal_mask_key), book.subgoal_mask_key, book.subgoal_mask_key)
            if book.max_option_steps is not None:
                steps, init = book.option_steps_key, book.option_init_key
                yield Carried(name_of(steps), steps, steps, void=init)
        else:
            yield Carried(f"last_{keys.OBSERVATION}", keys.OBSERVATION, keys.OBSERVATION)
            yield Carried(f"last_{keys.ACTION}", keys.ACTION, keys.ACTION)
            yield Carried(keys.AVAILABLE, keys.AVAILABLE, keys.AVAILABLE)


def _left(now: TensorDictBase, part: Carried) -> Tensor:
    value = now.get(part.after)
    return value if part.void is None else value.masked_fill(now.get(part.void), 0)
