"""From steps to options: what the meta-controller learns from (line 24 of Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor

from hdrqn_torchrl import keys
from hdrqn_torchrl.data.history import HISTORY, HISTORY_STEPS, HISTORY_SUBGOAL, OptionHistory


class OptionExtractor:
    r"""Turns collected steps ``[N, T]`` into option transitions :math:`(\hat{o}_0, g, r^{ex}_{total}, \hat{o}')`.

    A transition pairs the step at which an option started with the one at which it ended, however many
    batches lie between them. Transitions come out by whole episodes, each in order and without gaps, once the
    episode is over; so a replay buffer can hold them row by row. Of an episode that is very long or has no end, a piece
    comes out now and then: each transition is as it would have been, but sequences do not go from one piece to the
    next unless they lie side by side. Batches must come from one collector, in order, with the same N environments.

    Args:
        input_keys: what the meta-controller reads; kept from the start and, under ``"next"``, from the end.
        mask_key: subgoals that can be chosen, kept likewise; ``None``: no mask.
        subgoal_key: name of the chosen subgoal in the transitions (its value is ``active_subgoal_key``'s).
        option_init_key, option_done_key, option_steps_key, option_return_key, active_subgoal_key: entries of
            :class:`~hdrqn_torchrl.transforms.SubgoalTransform`.
        init_key: first step of an episode.
        traj_key: number of the episode.
        at_end: changes the entries ``[M]`` of the steps at which options ended before they are kept; for inputs
            that the environment's step does not hold.
        state_keys: kept from the start only: the meta-controller's LSTM state before it chose.
        history: keeps the observations of whole options in the transitions, so that
            :func:`~hdrqn_torchrl.data.refresh_hidden` can compute v2's inputs anew.
        max_held: finished options of an unfinished episode that are held back, for each environment; if there are more,
            they come out.

    Raises:
        ValueError: if ``max_held`` is less than 1.

    Examples:
        >>> from torchrl.envs import Compose, InitTracker, TransformedEnv
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.transforms import SubgoalTransform
        >>> transforms = Compose(InitTracker(), SubgoalTransform(num_subgoals=2))
        >>> env = TransformedEnv(MultiGoalGridEnv(num_envs=4, max_steps=5, seed=0), transforms)
        >>> steps = env.rollout(5, break_when_any_done=False)
        >>> steps["collector", "traj_ids"] = torch.arange(4)[:, None].expand(4, 5)
        >>> options = OptionExtractor(input_keys=["observation"])(steps)
        >>> int(options["next", "option_steps"].sum())
        20
    """

    def __init__(
        self,
        *,
        input_keys: Sequence[NestedKey] = (keys.OBSERVATION,),
        mask_key: NestedKey | None = keys.SUBGOAL_MASK,
        subgoal_key: NestedKey = keys.SUBGOAL,
        option_init_key: NestedKey = keys.OPTION_INIT,
        option_done_key: NestedKey = keys.OPTION_DONE,
        option_steps_key: NestedKey = keys.OPTION_STEPS,
        option_return_key: NestedKey = keys.OPTION_RETURN,
        active_subgoal_key: NestedKey = keys.ACTIVE_SUBGOAL,
        init_key: NestedKey = keys.IS_INIT,
        traj_key: NestedKey = keys.TRAJ_IDS,
        at_end: Callable[[TensorDictBase], TensorDictBase] | None = None,
        state_keys: Sequence[NestedKey] = (),
        history: OptionHistory | None = None,
        max_held: int = 1_000,
    ) -> None:
        if max_held < 1:
            raise ValueError(f"max_held must be >= 1 option, got {max_held}; use some multiple of slice_len.")
        self.max_held = max_held
        self.at_end, self.history = at_end, history
        self.init_key, self.traj_key, self.option_steps_key = init_key, traj_key, option_steps_key
        self.option_init_key, self.option_done_key = option_init_key, option_done_key
        self.active_subgoal_key, self.subgoal_key = active_subgoal_key, subgoal_key
        self.option_return_key, self.input_keys = option_return_key, list(input_keys)
        inputs = [*input_keys, *([] if mask_key is None else [mask_key])]
        self._start_keys = [*inputs, *state_keys, init_key, traj_key]
        self._end_keys = [*inputs, option_steps_key, option_return_key, keys.DONE, keys.TERMINATED]
        self.reset()

    def reset(self) -> None:
        """Forgets options and episodes in progress (the collector started new episodes)."""
        self._open_starts: TensorDictBase | None = None  # [N]: start of the option in progress
        self._is_open: Tensor | None = None  # [N]
        self._held: TensorDictBase | None = None  # [M]: finished options of unfinished episodes
        self._last: TensorDictBase | None = None  # [N]: the last one that came out of an unfinished episode
        if self.history is not None:
            self.history.reset()

    def __call__(self, batch: TensorDictBase) -> TensorDictBase | None:
        """Returns the options ``[M]`` of all episodes that ended in ``batch`` ``[N, T]``; ``None`` if none did.

        Raises:
            ValueError: if the batch is of another number of environments than the ones before.
        """
        if self._is_open is not None and len(self._is_open) != len(batch):
            raise ValueError(
                f"batch must hold the same {len(self._is_open)} environments as those before, got {len(batch)}; give "
                "each memory the batches of one collector."
            )
        starts = batch.select(*self._start_keys)
        started = batch.get(self.option_init_key).squeeze(-1)
        ended = batch.get(unravel_key(("next", self.option_done_key))).squeeze(-1)
        if self._is_open is None or self._open_starts is None:
            self._open_starts, self._is_open = starts[:, 0].clone(), torch.zeros_like(started[:, 0])
        starts = torch.cat([self._open_starts.unsqueeze(1), starts], 1)  # [N, 1 + T]: in progress, then new
        # A batch that begins with a start where an option was open follows a reset: that option is lost.
        started = torch.cat([(self._is_open & ~started[:, 0]).unsqueeze(1), started], 1)
        ended = ended & (started.cumsum(1)[:, 1:] > 0)  # an option that started before the first batch is unknown

        histories = None if self.history is None else self.history(batch, started[:, 1:], ended)

        # In each environment starts and ends alternate, so the j-th end closes the j-th start; a last start may
        # be left over. Both lists below are sorted by environment, then by time.
        self._is_open = started.sum(1) > ended.sum(1)
        last_start = started.shape[1] - 1 - started.flip(1).long().argmax(1)
        environments = torch.arange(len(started), device=started.device)
        self._open_starts = starts[environments, last_start]
        started[environments, last_start] &= ~self._is_open
        options = self._pair(batch, starts, started, ended)
        if histories is not None:
            after = options.get("next")
            after.set(HISTORY, histories)
            after.set(HISTORY_SUBGOAL, options.get(self.subgoal_key))
            after.set(HISTORY_STEPS, after.get(self.option_steps_key))
        return self._release(options, num_envs=len(batch))

    def _pair(self, batch: TensorDictBase, starts: TensorDictBase, started: Tensor, ended: Tensor) -> TensorDictBase:
        environment, end_time = ended.nonzero(as_tuple=True)
        options = starts[started.nonzero(as_tuple=True)]  # and not by mask: a GPU would count anew for every entry
        after = batch.get("next")[environment, end_time]
        if self.at_end is not None:
            after = self.at_end(after)
        options.set(self.subgoal_key, after.get(self.active_subgoal_key))
        options.set("next", select_after(after, self._end_keys))
        return options.set("environment", environment)

    def _release(self, options: TensorDictBase, num_envs: int) -> TensorDictBase | None:
        if self._held is not None:
            options = torch.cat([self._held, options], 0)
            options = options[options.get("environment").argsort(stable=True)]
        environment, rows = options.get("environment"), torch.arange(len(options), device=options.device)
        ends = torch.where(options.get(("next", keys.DONE)).squeeze(-1), rows, -1)
        last_end = rows.new_full((num_envs,), -1).scatter_reduce(0, environment, ends, "amax")
        complete = rows <= last_end[environment]
        held = torch.zeros_like(last_end).scatter_add(0, environment, (~complete).long())
        goes_on = held > self.max_held  # [N]
        complete |= goes_on[environment]
        self._held = options[(~complete).nonzero().squeeze(-1)]
        released = options[complete.nonzero().squeeze(-1)]
        if self.history is not None:
            self._look_back(released, goes_on)
        return released.exclude("environment") if len(released) else None

    def _look_back(self, options: TensorDictBase, goes_on: Tensor) -> None:
        """Gives each option the history of the one before it in its episode: what its first input comes from."""
        traj, environment = options.get(self.traj_key), options.get("environment")
        first = options.get(self.init_key).flatten() | (traj != traj.roll(1))  # or its predecessor is unknown
        first[:1] = True
        names = (HISTORY, HISTORY_SUBGOAL, HISTORY_STEPS)
        for key in names:
            before = options.get(("next", key)).roll(1, 0)
            options.set(key, before.masked_fill(first.view(-1, *[1] * (before.ndim - 1)), 0))
        if self._last is not None:  # of an episode that goes on
            before = self._last[environment]
            known = first & ~options.get(self.init_key).flatten() & (before.get(self.traj_key) == traj)
            known &= before.get("environment") == environment
            for key in names:
                options.get(key)[known] = before.get(("next", key))[known]
        if goes_on.any():
            rows = torch.arange(len(options), device=traj.device)
            newest = rows.new_zeros(len(goes_on)).scatter_reduce(0, environment, rows, "amax")
            last = options[newest].select("environment", self.traj_key, *(("next", key) for key in names))
            if self._last is not None:
                last = last.where(goes_on, self._last)
            self._last = last

    def state_dict(self) -> dict[str, Any]:
        """Options and episodes in progress."""
        state: dict[str, Any] = {"open_starts": self._open_starts, "is_open": self._is_open, "held": self._held}
        if self._last is not None:
            state["last"] = self._last
        return state if self.history is None else {**state, "history": self.history.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self._open_starts, self._is_open, self._held = state["open_starts"], state["is_open"], state["held"]
        self._last = state.get("last")
        if self.history is not None:
            self.history.load_state_dict(state["history"])


def select_after(after: TensorDictBase, wanted: Sequence[NestedKey]) -> TensorDictBase:
    """What is kept of what followed; ``truncated`` as well, which not every environment has."""
    return after.select(*wanted, *([keys.TRUNCATED] if keys.TRUNCATED in after else []))


class StepSelector:
    """Keeps of collected steps ``[N, T]`` what the sub-controller (or a flat agent) learns from.

    Args:
        root_keys: entries kept from the root.
        next_keys: entries kept from ``"next"``, beside the ends of the episode.
        subgoal_key: if given, the subgoal in force at each step is stored under this name, root and ``"next"``
            (in a policy's raw output the root entry is a mere proposal).
        active_subgoal_key: where the environment wrote the subgoal in force.
        traj_key: number of the episode.
    """

    def __init__(
        self,
        *,
        root_keys: Sequence[NestedKey],
        next_keys: Sequence[NestedKey],
        subgoal_key: NestedKey | None = None,
        active_subgoal_key: NestedKey = keys.ACTIVE_SUBGOAL,
        traj_key: NestedKey = keys.TRAJ_IDS,
    ) -> None:
        self.root_keys, self.subgoal_key, self.active_subgoal_key = list(root_keys), subgoal_key, active_subgoal_key
        self.next_keys = [*next_keys, keys.DONE, keys.TERMINATED]
        self.traj_key = traj_key

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns steps ``[N, T]``."""
        steps = batch.select(*self.root_keys, self.traj_key)
        after = select_after(batch.get("next"), self.next_keys)
        if self.subgoal_key is not None:
            in_force = batch.get(unravel_key(("next", self.active_subgoal_key)))
            steps.set(self.subgoal_key, in_force)
            after.set(self.subgoal_key, in_force)
        return steps.set("next", after)

    def state_dict(self) -> dict[str, Any]:
        """Nothing: it looks at one batch at a time."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes what :meth:`state_dict` returned."""
