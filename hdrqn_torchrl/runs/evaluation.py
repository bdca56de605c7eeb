"""Greedy evaluation on fixed seeds."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, ExplorationType

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs import Task, task_of
from hdrqn_torchrl.modules.sizes import check_size
from hdrqn_torchrl.runs.episode_tracker import EpisodeTracker
from hdrqn_torchrl.runs.isolation import isolated

_FIGURES = {
    "return_mean": "return",
    "extrinsic_mean": "extrinsic",
    "intrinsic_mean": "intrinsic",
    "success_rate": "success",
    "in_order_rate": "in_order",
    "steps_mean": "steps",
    "cut_off_rate": "cut_off",
}
LONGEST_EPISODE = 10_000
"""Steps after which an episode of unknown length is taken to have no end; tasks of longer ones state their length."""
PATIENCE = 1_000
"""Steps after which an evaluation asks for a limit if no episode has ended, or says that it waits for some."""


class Observer(Protocol):
    """Something that counts what happens."""

    def add_step(self, step: TensorDictBase, counted: Tensor | None = None) -> None:
        """Takes one step of all environments ``[N]``, its outcome below ``"next"``; only those ``counted`` count."""
        ...


class PlaceCounter:
    """Counts where agents are on a screen: a heat map.

    Args:
        height, width: of the screen in pixels.
        cell: side of a cell of the map in pixels.

    Examples:
        >>> from tensordict import TensorDict
        >>> places = PlaceCounter(8, 8, cell=4)
        >>> after = {"position": torch.tensor([[1.0, 2.0], [7.0, 3.0]])}
        >>> places.add_step(TensorDict({"next": after}, [2]))
        >>> places.counts.tolist()
        [[1, 1], [0, 0]]
    """

    def __init__(self, height: int, width: int, cell: int = 2) -> None:
        self.cell = cell
        self.counts = torch.zeros(-(-height // cell), -(-width // cell), dtype=torch.int64)

    def add_step(self, step: TensorDictBase, counted: Tensor | None = None) -> None:
        """Reads ``position`` after one step of all environments ``[N]``; see :class:`Observer`."""
        rows, columns = self.counts.shape
        x, y = (step.get(("next", keys.POSITION)).cpu() / self.cell).long().unbind(-1)
        index = y.clamp(0, rows - 1) * columns + x.clamp(0, columns - 1)
        weight = torch.ones_like(index) if counted is None else counted.cpu().long()
        self.counts.view(-1).index_add_(0, index, weight)


@torch.no_grad()
def play(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    episodes: int,
    seed: int = 0,
    exploration_type: ExplorationType = ExplorationType.DETERMINISTIC,
    observers: Sequence[Observer] = (),
    max_steps: int | None = None,
    check: Callable[[], None] | None = None,
) -> TensorDictBase:
    """Plays episodes, in rounds of one per environment.

    A training that goes on meanwhile is not affected (:func:`~hdrqn_torchrl.runs.isolation.isolated`).
    Every environment contributes the same number of episodes: taking the first that finish would favour short
    ones. (TorchRL's ``Evaluator`` does that, hence this function.)

    Before each round environment and random numbers are seeded anew, from ``seed`` and the round's number. So episode i
    begins in the same world for every policy, whatever was played before, and differences between two policies can be
    taken episode by episode. Which world that is depends on ``seed`` and N. What an environment draws later in an
    episode (sticky actions, obstacles that move) may differ between policies.

    Args:
        env: environment with batch size ``[N]``, not that of a training: its episodes would be lost.
        policy: greedy under the default ``exploration_type``.
        episodes: number of episodes, rounded up to a multiple of N.
        seed: of the first round; those of the others are derived from it.
        exploration_type: ``ExplorationType.RANDOM`` plays with the policy's current epsilon.
        observers: are shown every step and told where it belongs to an episode that counts: environments that are done
            with theirs go on, and short episodes would be seen too often.
        max_steps: steps after which an episode is cut off if it has not ended before; needed for tasks without end.
        check: called before each step; it may raise to cut the playing off, which leaves no trace
            (:meth:`~hdrqn_torchrl.runs.interruption.StopRequest.check`).

    Returns:
        One row ``[M]`` per episode, with the entries of ``EpisodeTracker(per_subgoal=True)`` and, if ``max_steps`` is
        given, ``cut_off`` (1 if it was).

    Raises:
        ValueError: if ``episodes`` or ``max_steps`` is below 1, or if without it an episode does not end: after as many
            steps as the task states or, if it states none, :data:`LONGEST_EPISODE`, or :data:`PATIENCE` if none ends at
            all.

    Examples:
        >>> from hdrqn_torchrl.algorithms import make_hdrqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> env = MultiGoalGridEnv(num_envs=4, max_steps=10)
        >>> agent = make_hdrqn(env, compact_network(8, (8,)))
        >>> played = play(agent.transform(env), agent.policy, episodes=8)
        >>> played["return"].shape, played["reached"].shape
        (torch.Size([8]), torch.Size([8, 2]))
    """
    check_size("episodes", episodes, 100)
    if max_steps is not None and max_steps < 1:
        raise ValueError(f"max_steps must be >= 1 or None, got {max_steps}; None plays episodes to their end.")
    rounds, task = [], task_of(env)
    for number in range(-(-episodes // env.batch_size[0])):
        with isolated(env, policy, seed=seed_of_round(seed, number), exploration_type=exploration_type):
            rounds.append(_play_once(env, policy, observers, task, max_steps, check))
    return torch.cat(rounds, 0)  # type: ignore[return-value]


def seed_of_round(seed: int, number: int) -> int:
    """Seed of a round of episodes: ``seed`` itself for the first; neighbouring seeds share none of the others.

    Examples:
        >>> seed_of_round(7, 0), seed_of_round(7, 1) == seed_of_round(8, 1)
        (7, False)
    """
    if number == 0:
        return seed
    return int(numpy.random.SeedSequence([seed % 2**64, number]).generate_state(1)[0]) >> 1  # 31 bits suit every env


def evaluate(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    episodes: int,
    seed: int = 0,
    exploration_type: ExplorationType = ExplorationType.DETERMINISTIC,
    max_steps: int | None = None,
    check: Callable[[], None] | None = None,
) -> dict[str, float]:
    """Plays episodes and averages them; arguments as in :func:`play`.

    Returns:
        ``return_mean``, ``steps_mean``, ``episodes`` and, as far as environment and agent have them,
        ``extrinsic_mean``, ``intrinsic_mean``, ``success_rate`` (share of episodes that complete the whole task),
        ``in_order_rate`` (share of subgoals reached in the proper order), ``cut_off_rate``.

    Examples:
        >>> from hdrqn_torchrl.algorithms import make_hdrqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> env = MultiGoalGridEnv(num_envs=4, max_steps=10)
        >>> agent = make_hdrqn(env, compact_network(8, (8,)))
        >>> list(evaluate(agent.transform(env), agent.policy, episodes=4))
        ['return_mean', 'extrinsic_mean', 'intrinsic_mean', 'success_rate', 'in_order_rate', 'steps_mean', 'episodes']
    """
    played = play(
        env,
        policy,
        episodes=episodes,
        seed=seed,
        exploration_type=exploration_type,
        max_steps=max_steps,
        check=check,
    )
    return {**{name: _mean(values) for name, values in columns(played).items()}, "episodes": len(played)}


def columns(played: TensorDictBase) -> dict[str, Tensor]:
    """The figures that a result consists of, one value per episode ``[M]`` each."""
    return {name: played[entry] for name, entry in _FIGURES.items() if entry in played}


def _play_once(
    env: EnvBase,
    policy: TensorDictModuleBase,
    observers: Sequence[Observer],
    task: Task,
    max_steps: int | None,
    check: Callable[[], None] | None,
) -> TensorDictBase:
    """One episode in each environment, ``[N]``."""
    tensordict, tracker = env.reset(), EpisodeTracker(task, per_subgoal=True)
    playing = torch.ones(env.batch_size, dtype=torch.bool, device=tensordict.device)
    episodes: TensorDictBase | None = None
    longest = max_steps or task.max_steps or LONGEST_EPISODE
    for step in range(longest):
        if check is not None:
            check()
        if step == PATIENCE and max_steps is None and task.max_steps is None:
            _ask_for_a_limit(playing)
        tensordict, following = env.step_and_maybe_reset(policy(tensordict))
        after = tensordict.get("next")
        if step + 1 == max_steps:
            _end_options(after, task)
        sums = tracker.add(after)
        for observer in observers:
            observer.add_step(tensordict, playing)
        ended = playing & after.get(keys.DONE).squeeze(-1)
        episodes = sums if episodes is None else torch.where(ended, sums, episodes)
        playing, tensordict = playing & ~ended, following
        if not playing.any():
            break
    assert episodes is not None
    if max_steps is not None:
        cut: TensorDictBase = torch.where(playing, sums, episodes)  # type: ignore[assignment]
        return cut.set("cut_off", playing.float())
    if playing.any():
        raise ValueError(
            f"env must end its episodes, got {int(playing.sum())} of {len(playing)} that had not ended after "
            f"{longest:,} steps; give it a time limit (StepCounter(max_steps=...), before the agent's own transforms), "
            "state the length of longer ones in its task, or let evaluations cut them off (max_steps)."
        )
    return episodes


def _end_options(after: TensorDictBase, task: Task) -> None:
    """Ends the options of all levels where episodes are cut off: one still going on has not reached its subgoal."""
    for each in task.subgoals:
        if (done := after.get(each.keys.option_done, None)) is not None:
            after.set(each.keys.option_done, torch.ones_like(done))


def _ask_for_a_limit(playing: Tensor) -> None:
    """Refuses to wait where no episode ``[N]`` has ended; says how long it may take where some have."""
    if playing.all():
        raise ValueError(
            f"max_steps must be given where no length of episodes is known and none of {len(playing)} has ended after "
            f"{PATIENCE:,} steps, got None; evaluation.max_steps=1000 cuts them off."
        )
    warnings.warn(
        f"env should end its episodes or state how long they are, got {int(playing.sum())} of {len(playing)} that have "
        f"not ended after {PATIENCE:,} steps; an evaluation waits for {LONGEST_EPISODE:,}, or evaluation.max_steps.",
        stacklevel=5,
    )


def _mean(values: Tensor) -> float:
    return values.mean().item()
