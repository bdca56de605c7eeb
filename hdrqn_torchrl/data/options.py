"""From steps to options: what the meta-controller learns from (line 24 of Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from hdrqn_torchrl import keys
from hdrqn_torchrl.data.history import HISTORY, HISTORY_STEPS, HISTORY_SUBGOAL, OptionHistory


class OptionExtractor:
    r"""Turns collected steps ``[N, T]`` into rows :math:`(\hat{o}, g, r^{ex}_{total})`, one for each option.

    A row joins the step at which an option started with the one at which it ended, however many batches lie between
    them. What an option led to is what the next row of its episode starts from, so it is not stored again. Where an
    episode is truncated, and nothing follows, one more row holds its last inputs: a *final row*, done and not
    terminated, with nothing chosen. It can't be trained; samplers never begin with it.

    Rows come out by whole episodes, each in order and without gaps, once the episode is over; so a replay buffer can
    hold them one after the other. Of an episode that is very long or has no end, a piece comes out from time to time. A
    piece also ends with a final row: a copy of the row that the next piece begins with. So each option is learned
    from, but sequences do not go from one piece to the next, as each has a number of its own (:func:`episode_of`).
    Batches must come from one collector, in order, with the same N environments.

    Args:
        input_keys: what the controller reads, kept from where the option started.
        mask_key: subgoals that can be chosen, kept likewise; ``None``: no mask.
        subgoal_key: name of the chosen subgoal in the rows (its value is ``active_subgoal_key``'s).
        option_init_key, option_done_key, option_steps_key, option_return_key, active_subgoal_key: entries of
            :class:`~hdrqn_torchrl.transforms.SubgoalTransform`.
        init_key: where the controller's recurrent state restarts: at the first step of an episode, or, below another
            level, where that one's option starts.
        done_key, terminated_key: under ``"next"``, end of what the controller pursues: the episode, or the option of
            the level above.
        condition_key: name, in the rows, of the subgoal that the level above pursued; ``None``: there is no such level.
        active_condition_key: the entry that has its value, under ``"next"``.
        traj_key: number of the episode.
        at_end: changes the entries ``[M]`` of the steps at which truncated episodes ended before they are kept; for
            inputs that the environment's step does not hold.
        state_keys: more entries of the step at which the option started, the controller's recurrent state for
            instance; final rows have none.
        history: keeps the observations of the option before in each row, so that
            :func:`~hdrqn_torchrl.data.refresh_hidden` can recompute v2's inputs.
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
        done_key: NestedKey = keys.DONE,
        terminated_key: NestedKey = keys.TERMINATED,
        condition_key: NestedKey | None = None,
        active_condition_key: NestedKey = keys.ACTIVE_SUBGOAL,
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
        self.init_key, self.done_key, self.terminated_key = init_key, done_key, terminated_key
        self.condition_key, self.active_condition_key = condition_key, active_condition_key
        self.traj_key, self.option_steps_key = traj_key, option_steps_key
        self.option_init_key, self.option_done_key = option_init_key, option_done_key
        self.active_subgoal_key, self.subgoal_key = active_subgoal_key, subgoal_key
        self.option_return_key, self.input_keys, self.state_keys = option_return_key, list(input_keys), list(state_keys)
        self._inputs = [*input_keys, *([] if mask_key is None else [mask_key])]
        self.reset()

    def reset(self) -> None:
        """Forgets options in progress, and those that wait for the end of their episode."""
        self._open_starts: TensorDictBase | None = None  # [N]: start of the option in progress
        self._is_open: Tensor | None = None  # [N]
        self._held: TensorDictBase | None = None  # [M]: finished options of unfinished episodes
        self._pieces: Tensor | None = None  # [N]: pieces that came out of the episode ...
        self._episode: Tensor | None = None  # [N]: ... of this number
        if self.history is not None:
            self.history.reset()

    def __call__(self, batch: TensorDictBase) -> TensorDictBase | None:
        """Returns the rows ``[M]`` of all episodes that ended in ``batch`` ``[N, T]``; ``None`` if none did.

        Raises:
            ValueError: if the batch is of another number of environments than the ones before.
        """
        if self._is_open is not None and len(self._is_open) != len(batch):
            raise ValueError(
                f"batch must hold the same {len(self._is_open)} environments as those before, got {len(batch)}; give "
                "each memory the batches of one collector."
            )
        starts = batch.select(*self._inputs, *self.state_keys, self.init_key, self.traj_key)
        if self.condition_key is not None:
            starts.set(self.condition_key, batch.get("next").get(self.active_condition_key))
        started = batch.get(self.option_init_key).squeeze(-1)
        ended = batch.get("next").get(self.option_done_key).squeeze(-1)
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
        return self._release(self._pair(batch, starts, started, ended, histories), num_envs=len(batch))

    def _pair(
        self, batch: TensorDictBase, starts: TensorDictBase, started: Tensor, ended: Tensor, histories: Tensor | None
    ) -> TensorDictBase:
        """Rows of the options that ended, and final rows where episodes were truncated."""
        environment, end_time = ended.nonzero(as_tuple=True)
        options = starts[started.nonzero(as_tuple=True)]  # and not by mask: a GPU would count again for every entry
        after = batch.get("next")[environment, end_time]
        options.set(self.subgoal_key, after.get(self.active_subgoal_key))
        ends = after.select(self.option_steps_key, self.option_return_key, self.done_key, self.terminated_key)
        options.set("next", ends).set(_ENVIRONMENT, environment).set(_OVER, after.get(keys.DONE).squeeze(-1))
        if histories is not None:
            steps, subgoal = after.get(self.option_steps_key), options.get(self.subgoal_key)
            own = TensorDict({HISTORY: histories, HISTORY_SUBGOAL: subgoal, HISTORY_STEPS: steps}, options.batch_size)
            options.update(own.apply(torch.zeros_like)).set(_OWN, own)
        truncated = options.get(_OVER) & ~after.get(self.terminated_key).squeeze(-1)
        cut = truncated.nonzero().squeeze(-1)
        if not len(cut):
            return options
        final = self._as_final(self._show(options[cut], after[cut]))
        options.set(_OVER, options.get(_OVER) & ~truncated)
        options.get("next").set(self.done_key, ends.get(self.done_key) & ~truncated.unsqueeze(-1))
        order = torch.cat([2 * torch.arange(len(options), device=cut.device), 2 * cut + 1]).argsort()
        return torch.cat([options, final])[order]

    def _show(self, rows: TensorDictBase, after: TensorDictBase) -> TensorDictBase:
        """Rows that show what steps led to."""
        if self.at_end is not None:
            after = self.at_end(after)
        rows.update(after.select(*self._inputs))
        if self.condition_key is not None:
            rows.set(self.condition_key, after.get(self.active_condition_key))
        for key in (self.init_key, *self.state_keys):
            rows.set(key, torch.zeros_like(rows.get(key)))
        return rows

    def _as_final(self, rows: TensorDictBase) -> TensorDictBase:
        """Marks rows at which nothing was chosen: done, not terminated."""
        ends = rows.get("next").apply(torch.zeros_like)
        ends.set(self.done_key, torch.ones_like(ends.get(self.done_key)))
        return rows.set("next", ends).set(_OVER, torch.ones_like(rows.get(_OVER)))

    def _release(self, options: TensorDictBase, num_envs: int) -> TensorDictBase | None:
        if self._held is not None:
            options = _by_environment(self._held, options)
        if self.history is not None:
            self._look_back(options)
        environment, rows = options.get(_ENVIRONMENT), torch.arange(len(options), device=options.device)
        if self._pieces is None or self._episode is None:
            self._pieces, self._episode = torch.zeros((2, num_envs), dtype=torch.int64, device=options.device)
        episode = options.get(self.traj_key)
        numbers = episode + _PIECE * torch.where(episode == self._episode[environment], self._pieces[environment], 0)
        ends = torch.where(options.get(_OVER), rows, -1)
        last_end = rows.new_full((num_envs,), -1).scatter_reduce(0, environment, ends, "amax")
        complete = rows <= last_end[environment]
        held = torch.zeros_like(last_end).scatter_add(0, environment, (~complete).long())
        goes_on = held > self.max_held  # [N]
        newest = rows.new_zeros(num_envs).scatter_reduce(0, environment, rows, "amax")[goes_on]
        complete |= goes_on[environment]
        complete[newest] = False  # the next piece begins with it
        self._held = options[(~complete).nonzero().squeeze(-1)]
        options.set(self.traj_key, numbers)
        released = options[complete.nonzero().squeeze(-1)]
        if len(newest):
            released = _by_environment(released, self._as_final(options[newest]))
            self._pieces = self._pieces.masked_scatter(goes_on, numbers[newest] // _PIECE + 1)
            self._episode = self._episode.masked_scatter(goes_on, episode[newest])
        return released.exclude(_ENVIRONMENT, _OVER, _OWN) if len(released) else None

    def _look_back(self, options: TensorDictBase) -> None:
        """Gives each row the history of the option before it in its episode: what its input comes from."""
        traj, environment = options.get(self.traj_key), options.get(_ENVIRONMENT)
        follows = (traj == traj.roll(1)) & (environment == environment.roll(1))
        follows[:1] = False
        for key in (HISTORY, HISTORY_SUBGOAL, HISTORY_STEPS):
            before, known = options.get((_OWN, key)).roll(1, 0), options.get(key)
            options.set(key, torch.where(follows.view(-1, *[1] * (known.ndim - 1)), before, known))

    def state_dict(self) -> dict[str, Any]:
        """Options and episodes in progress."""
        state: dict[str, Any] = {"open_starts": self._open_starts, "is_open": self._is_open, "held": self._held}
        state |= {"pieces": self._pieces, "episode": self._episode}
        return state if self.history is None else {**state, "history": self.history.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned. Rows of versions that stored inputs twice are forgotten."""
        self._open_starts, self._is_open, self._held = state["open_starts"], state["is_open"], state["held"]
        if self._held is not None and _OVER not in self._held:
            self._held = None
        self._pieces, self._episode = state.get("pieces"), state.get("episode")
        if self.history is not None:
            self.history.load_state_dict(state["history"])


_PIECE = 2**44
"""Added to the number of a long episode for each piece of it that came out before."""


def episode_of(number: Tensor) -> Tensor:
    """The number of the episode that options are of, whichever piece of it they came out in.

    Args:
        number: entry of :class:`OptionExtractor`'s rows.

    Examples:
        >>> episode_of(torch.tensor([7, 7 + 2**44, 7 + 2**45]))
        tensor([7, 7, 7])
    """
    return number % _PIECE


_ENVIRONMENT, _OVER, _OWN = "environment", "over", "own"
"""What only held rows have: whose they are, whether their episode is over, and their own history."""


def _by_environment(*rows: TensorDictBase) -> TensorDictBase:
    together: TensorDictBase = torch.cat(rows)  # type: ignore[assignment]
    return together[together.get(_ENVIRONMENT).argsort(stable=True)]
