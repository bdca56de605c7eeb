"""What experience teaches about subgoals that were not pursued, for agents whose networks take the subgoal as input.

Off-policy Q-learning may learn about any subgoal from any step (Kaelbling, 1993; HER, Andrychowicz et al., 2017). At
the sub level :func:`relabel_subgoals` shows each replayed sequence once for every subgoal; at the meta level
:class:`HindsightOptions` replays each episode once more as if every option had been chosen for what it attained.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor

from hdrqn_torchrl import keys
from hdrqn_torchrl.data.options import OptionExtractor, episode_of
from hdrqn_torchrl.transforms import IntrinsicReward, advance_option


def relabel_subgoals(
    sample: TensorDictBase,
    num_subgoals: int,
    *,
    rewards: IntrinsicReward = IntrinsicReward(),  # noqa: B008 (frozen)
    state_keys: Sequence[NestedKey] = (),
    subgoal_key: NestedKey = keys.SUBGOAL,
    attained_key: NestedKey = keys.ATTAINED,
    hazard_key: NestedKey | None = keys.HAZARD,
    mask_key: NestedKey = keys.SUBGOAL_MASK,
    option_init_key: NestedKey = keys.OPTION_INIT,
    option_done_key: NestedKey = keys.OPTION_DONE,
    option_terminated_key: NestedKey = keys.OPTION_TERMINATED,
    upper_done_key: NestedKey | None = None,
    upper_terminated_key: NestedKey | None = None,
    intrinsic_reward_key: NestedKey = keys.INTRINSIC_REWARD,
    eligible_key: NestedKey = keys.ELIGIBLE,
) -> TensorDictBase:
    """Shows each sequence as it was, then as if the sub-controller had been sent to each other subgoal instead.

    Relabelled for a subgoal g other than the one pursued at its first step, a sequence differs as acting would have:

    - g is in force throughout, and reward and termination of each step are those of g;
    - the option ends where g is reached, or lost: it can't be chosen any more, and is worth nothing. Reaching the
      subgoal really pursued, or losing it, does not end an option for g, so there the recurrent state goes on; to cut
      the sequence there would leave out steps *because* of what they attained, which biases values. Every other end
      (episode, time limit, the option of the level above) ends one for g, too;
    - where g could not be chosen, since it had been attained before or was not available, a step is not eligible for
      the loss. The next eligible one starts an option, so these steps reach no target and no state that is trained.

    Args:
        sample: sequences ``[B, T]`` of the sub level with ``attained``, ``hazard`` and ``subgoal_mask``.
        num_subgoals: G.
        rewards: what the option book paid by.
        state_keys: recurrent states stored with the steps, if any. They come from the subgoal that was pursued;
            relabelled for another one, a sequence starts from zero.
        subgoal_key: subgoal in force.
        attained_key, hazard_key, option_done_key, option_terminated_key, intrinsic_reward_key: under ``"next"``;
            ``hazard_key=None``: no hazard.
        upper_done_key, upper_terminated_key: the same of the option of the level above, under ``"next"``; ``None``:
            there is none.
        mask_key, option_init_key: at the root, like the subgoal.
        eligible_key: written at the root, for :class:`~hdrqn_torchrl.objectives.RecurrentDQNLoss`; steps that are not
            eligible in ``sample``, the last that a step limit allows, stay so and end an option for g, too.

    Returns:
        ``[G * B, T]``, the sequences as they were first. An update costs accordingly more; a batch size of B / G costs
        what one without hindsight does.

    Examples:
        >>> from tensordict import TensorDict
        >>> no, one = torch.zeros(1, 3, 1, dtype=torch.bool), torch.ones(1, 3, dtype=torch.int64)
        >>> attained = torch.tensor([[[False, False], [True, False], [False, False]]])
        >>> after = {"attained": attained, "hazard": no, "intrinsic_reward": torch.zeros(1, 3, 1)}
        >>> after |= {key: no for key in ("done", "terminated", "option_done", "option_terminated")}
        >>> root = {"subgoal": one, "subgoal_mask": torch.ones_like(attained), "option_init": no}
        >>> told = relabel_subgoals(TensorDict({**root, "next": after}, [1, 3]), num_subgoals=2)
        >>> told["subgoal"].tolist(), told["next", "intrinsic_reward"].squeeze(-1).tolist()
        ([[1, 1, 1], [0, 0, 0]], [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    """
    shift = torch.arange(num_subgoals, device=sample.device).repeat_interleave(len(sample)).view(-1, 1, 1)
    told: TensorDictBase = torch.cat([sample] * num_subgoals)  # type: ignore[assignment]  # [G * B, T]
    after = told.get("next")
    pursued, attained, left = told.get(subgoal_key).unsqueeze(-1), after.get(attained_key), told.get(mask_key)
    subgoal = torch.where(shift > 0, (pursued[:, :1] + shift) % num_subgoals, pursued)  # [G * B, T, 1]

    stays = left & torch.cat([left[:, 1:], torch.ones_like(left[:, :1])], 1)
    reached, eligible = attained.gather(-1, subgoal), left.gather(-1, subgoal)
    lost = eligible & ~stays.gather(-1, subgoal) & ~reached & ~after.get(keys.DONE)
    own = attained.gather(-1, pursued) | ~stays.gather(-1, pursued)  # ends an option for the pursued subgoal alone
    terminated = reached | lost | after.get(keys.TERMINATED)
    cut = (after.get(option_done_key) & ~own) | after.get(keys.DONE)
    if upper_terminated_key is not None:
        terminated = terminated | after.get(upper_terminated_key)
    if upper_done_key is not None:
        cut = cut | after.get(upper_done_key)
    before = told.get(eligible_key, None)
    if before is not None:
        cut = cut | ~before
    done = terminated | cut | ~stays.gather(-1, subgoal)
    init = torch.cat([told.get(option_init_key)[:, :1], done[:, :-1]], 1)
    reward = rewards.of(attained, reached, None if hazard_key is None else after.get(hazard_key))
    for part, key, value in (
        (told, option_init_key, init),
        (after, option_done_key, done),
        (after, option_terminated_key, terminated),
        (after, intrinsic_reward_key, reward),
    ):
        part.set(key, torch.where(shift > 0, value, part.get(key)))
    told.set(subgoal_key, subgoal.squeeze(-1))
    for key in state_keys:
        told.set(key, told.get(key).masked_fill(shift > 0, 0.0))
    eligible = (shift == 0) | eligible
    return told.set(eligible_key, eligible if before is None else eligible & before)


class HindsightOptions:
    r"""The options ``[M]`` of finished episodes, and the same episodes relabelled by what each option attained.

    An option that pursued g from :math:`s_0` to :math:`s_k` and attained g' on its way, at :math:`s_j`, becomes two:
    g' from :math:`s_0` to :math:`s_j`, and g from there on. Each has its own return and steps, and the second starts
    from what the meta-controller would have read at :math:`s_j`: the observation (v1) or the sub-controller's state as
    it was (v2; with ``OptionHistory`` it can be computed again as if the sub-controller had pursued g'). Episodes in
    which every option attained its own subgoal or none are not repeated. The others follow as separate trajectories,
    numbered :math:`-1 - n` for the episode :math:`n`, so that no sequence mixes the two.

    Relabelled options have always attained something: the values of choices are biased towards success.

    Args:
        pursued: extracts the options as they were.
        retold: the same settings, but with an ``active_subgoal_key`` (and a history, if any) of its own.
        gamma: discount inside an option, as in :class:`~hdrqn_torchrl.transforms.SubgoalTransform`.
        at_start: changes the root entries ``[S]`` of the steps at which only relabelled options start; for inputs that
            are not at the root of such a step.
        attained_key, extrinsic_reward_key: under ``"next"``.
        mask_key: subgoals not yet attained. Of several that a step attains the first counts.

    Raises:
        ValueError: if both extractors read the subgoal under the same key.

    Examples:
        >>> pursued, retold = OptionExtractor(), OptionExtractor(active_subgoal_key=keys.HINDSIGHT_SUBGOAL)
        >>> sorted(HindsightOptions(pursued, retold, gamma=0.99).state_dict()["hindsight"])
        ['changed', 'collected', 'retold', 'split', 'steps']
    """

    def __init__(
        self,
        pursued: OptionExtractor,
        retold: OptionExtractor,
        *,
        gamma: float = 0.99,
        at_start: Callable[[TensorDictBase], TensorDictBase] | None = None,
        attained_key: NestedKey = keys.ATTAINED,
        extrinsic_reward_key: NestedKey = keys.EXTRINSIC_REWARD,
        mask_key: NestedKey = keys.SUBGOAL_MASK,
    ) -> None:
        if retold.active_subgoal_key == pursued.active_subgoal_key:
            raise ValueError(
                f"active_subgoal_key of retold must differ from that of pursued, got {retold.active_subgoal_key!r} "
                f"for both; use {keys.HINDSIGHT_SUBGOAL!r}."
            )
        self.pursued, self.retold, self.gamma, self.at_start = pursued, retold, gamma, at_start
        self.attained_key, self.extrinsic_reward_key, self.mask_key = attained_key, extrinsic_reward_key, mask_key
        self._forget()

    def _forget(self) -> None:
        self._book: tuple[Tensor, Tensor] | None = None  # [N, 1] each: steps, return of the relabelled option
        self._split: Tensor | None = None  # [N, 1]: whether the last step ended a relabelled option only
        self._changed: Tensor | None = None  # numbers of the episodes in progress that are relabelled

    def reset(self) -> None:
        """Forgets options in progress, and those that wait for the end of their episode."""
        self._forget()
        self.pursued.reset()
        self.retold.reset()

    def __call__(self, batch: TensorDictBase) -> TensorDictBase | None:
        """Returns the options ``[M]`` of all episodes that ended in ``batch`` ``[N, T]``; ``None`` if none did."""
        as_they_were = self.pursued(batch)
        told, relabelled = self._retell(batch)
        in_hindsight = self._keep_changed(self.retold(told), batch.get(self.pursued.traj_key), relabelled)
        found = [options for options in (as_they_were, in_hindsight) if options is not None]
        return torch.cat(found) if found else None

    def _retell(self, batch: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
        """The batch as if options had been chosen for what they attained; steps ``[N, T]`` where that differs."""
        names, after = self.pursued, batch.get("next").copy()
        subgoal, attained = after.get(names.active_subgoal_key), after.get(self.attained_key)
        news = attained & batch.get(self.mask_key)  # [N, T, G]
        relabelled = news.any(-1) & ~attained.gather(-1, subgoal.unsqueeze(-1)).squeeze(-1)
        split, own_init = relabelled.unsqueeze(-1), batch.get(names.option_init_key)  # [N, T, 1]
        before = torch.zeros_like(split[:, :1]) if self._split is None else self._split.unsqueeze(1)
        init = own_init | torch.cat([before, split[:, :-1]], 1)
        self._split = split[:, -1]
        steps, collected = self._keep_book(init, after.get(self.extrinsic_reward_key))

        after.set(self.retold.active_subgoal_key, torch.where(relabelled, news.long().argmax(-1), subgoal))
        after.set(names.option_done_key, after.get(names.option_done_key) | split)
        after.set(names.option_steps_key, steps).set(names.option_return_key, collected)
        told = batch.exclude("next").set(names.option_init_key, init).set("next", after)
        return self._read_at_starts(told, (init & ~own_init).squeeze(-1)), relabelled

    def _keep_book(self, init: Tensor, reward: Tensor) -> tuple[Tensor, Tensor]:
        """Steps and returns of the relabelled options, ``[N, T, 1]`` each."""
        book = (torch.zeros_like(init[:, 0], dtype=torch.int64), torch.zeros_like(reward[:, 0]))
        book, pages = self._book or book, []
        for time in range(init.shape[1]):
            book = advance_option(init[:, time], *book, reward[:, time], self.gamma)
            pages.append(book)
        self._book = book
        steps, collected = zip(*pages, strict=True)
        return torch.stack(steps, 1), torch.stack(collected, 1)

    def _read_at_starts(self, told: TensorDictBase, starts: Tensor) -> TensorDictBase:
        """Puts what the meta-controller would have read where only relabelled options start, ``starts`` ``[N, T]``."""
        if self.at_start is None or not starts.any():
            return told
        rows = self.at_start(told.exclude("next")[starts])
        for key in self.pursued.input_keys:
            told.set(key, told.get(key).masked_scatter(expand_as_right(starts, told.get(key)), rows.get(key)))
        return told

    def _keep_changed(
        self, options: TensorDictBase | None, episode: Tensor, relabelled: Tensor
    ) -> TensorDictBase | None:
        """The options of relabelled episodes, under numbers of their own."""
        changed = episode[relabelled]
        if self._changed is not None:
            changed = torch.cat([self._changed, changed])
        self._changed = changed[torch.isin(changed, episode[:, -1])].unique()
        if options is None:
            return None
        number = options.get(self.retold.traj_key)
        options.set(self.retold.traj_key, -1 - number)
        return options[torch.isin(episode_of(number), changed)]

    def state_dict(self) -> dict[str, Any]:
        """Options and episodes in progress."""
        steps, collected = self._book or (None, None)
        hindsight = {"steps": steps, "collected": collected, "split": self._split, "changed": self._changed}
        return {**self.pursued.state_dict(), "hindsight": {**hindsight, "retold": self.retold.state_dict()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self.pursued.load_state_dict(state)
        state = state["hindsight"]
        self.retold.load_state_dict(state["retold"])
        self._book = None if state["steps"] is None else (state["steps"], state["collected"])
        self._split, self._changed = state["split"], state["changed"]
