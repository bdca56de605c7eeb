"""One level of hDQN, hDRQNv1 or hDRQNv2: its controller, and the learner that trains it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.algorithms.base import make_recurrent_loss, settings_named, stored_states
from hdrqn_torchrl.algorithms.levels import Level
from hdrqn_torchrl.algorithms.requirements import Requirements
from hdrqn_torchrl.data import (
    FROM_STARTS,
    HindsightOptions,
    OptionExtractor,
    OptionHistory,
    StepSelector,
    refresh_hidden,
    relabel_subgoals,
)
from hdrqn_torchrl.envs import Task
from hdrqn_torchrl.learning import Extract, Learner, LearnerSettings
from hdrqn_torchrl.modules import Architecture, EpsilonGreedy, MetaController, SubController
from hdrqn_torchrl.transforms import IntrinsicReward

LONGEST_HELD_EPISODE = 1_000
"""Steps of the longest episode whose options are stored all at once, when it is over."""
_META_INPUTS = {"hidden": ("hidden",), "cell": ("cell",), "both": ("hidden", "cell")}


@dataclass(frozen=True, kw_only=True)
class LevelBuilder:
    """Builds the parts of one agent's levels. Its arguments are those of :func:`make_hdrqn`.

    Args:
        has: what the environment has.
        penalties: intrinsic reward for attaining another subgoal than the chosen one, for each set, from near to far.
    """

    has: Requirements
    architecture: Architecture
    version: Literal["v1", "v2"]
    recurrent: bool
    gamma: float
    smdp_discount: bool
    meta_input: Literal["hidden", "cell", "both"]
    reads_last: bool
    refresh_hidden_steps: int | None
    mask_reached: bool
    repeatable_subgoals: bool | None
    hazard_reward: float
    penalties: tuple[float, ...]
    max_option_steps: int | None
    sub_hindsight: bool
    meta_hindsight: bool
    prediction_steps: int
    prediction_weight: float

    def sub_controller(self, exploration: EpsilonGreedy) -> SubController:
        """The controller of level 0."""
        level = self.has.levels[0]
        pursued = _keys_above(level)
        network = self.architecture.q_network(
            self.has.observation,
            num_actions=level.num_choices,
            num_conditions=level.num_conditions,
            recurrent=self.recurrent,
            prediction_steps=self.prediction_steps,
        )
        return SubController(
            network,
            exploration,
            subgoal_key=pursued.subgoal,
            init_key=pursued.option_init,
            mask_key=self.has.action_mask_key,
            option_keys=pursued,
            upper_option_keys=self._pursued_above(0),
        )

    def upper_controller(self, index: int, exploration: EpsilonGreedy) -> MetaController:
        """The controller of a level that chooses subgoals, ``index`` >= 1."""
        level, names = self.has.levels[index], _keys_of(self.has.levels[index])
        hidden_key, cell_key = _state_keys(level)
        input_keys: list[NestedKey] = [keys.OBSERVATION]
        inputs: Any = self.has.observation
        if self.version == "v2":
            input_keys = [f"{self.has.levels[index - 1].name}_{part}" for part in _META_INPUTS[self.meta_input]]
            inputs = len(input_keys) * self.architecture.hidden_size
        network = self.architecture.q_network(
            inputs, num_actions=level.num_choices, num_conditions=level.num_conditions, recurrent=self.recurrent
        )
        above = None if level.pursues is None else level.pursues.keys
        return MetaController(
            network,
            exploration,
            input_keys=input_keys,
            mask_key=names.subgoal_mask if self._is_masked(index) else None,
            condition_key=None if above is None else above.subgoal,
            init_key=None if above is None else above.option_init,
            subgoal_key=names.subgoal,
            gate_key=names.option_init,
            active_subgoal_key=names.active_subgoal,
            action_value_key=names.subgoal_value,
            hidden_key=hidden_key,
            cell_key=cell_key,
            exploration_key=names.exploration,
            option_keys=above or keys.OptionKeys(),
            upper_option_keys=self._pursued_above(index),
            return_key=names.option_return,
            steps_key=names.option_steps,
        )

    def sub_learner(self, controller: SubController, settings: LearnerSettings) -> Learner:
        """What trains level 0: single steps."""
        level, has = self.has.levels[0], self.has
        pursued, hindsight = _keys_above(level), self.sub_hindsight
        starts = [keys.IS_INIT] if settings.sampling in FROM_STARTS or has.event_keys else []
        above = self._pursued_above(0)
        ends_above = [] if above is None else [above.option_done, above.option_terminated]
        told = [pursued.attained, *has.event_keys, *has.hazard_keys, *ends_above] if hindsight else []
        limit = None if self.max_option_steps == 1 else self.max_option_steps  # of one step nothing would be left
        with settings_named(level.name):
            return Learner(
                controller,
                settings,
                extract=StepSelector(
                    root_keys=[
                        *(keys.OBSERVATION, keys.ACTION, pursued.option_init),
                        *starts,
                        *has.action_mask_keys,
                        *stored_states(controller, settings),
                        *([pursued.subgoal_mask] if hindsight else []),
                    ],
                    next_keys=[*_ends(pursued).values(), *told],
                    subgoal_key=pursued.subgoal,
                    active_subgoal_key=pursued.active_subgoal,
                    option_limit=limit,
                    option_steps_key=pursued.option_steps,
                ),
                loss=make_recurrent_loss(
                    controller,
                    settings,
                    gamma=self.gamma,
                    largest_return=self._rewards(0).largest_return,
                    loss_keys={"eligible": keys.ELIGIBLE if hindsight or limit else None},
                    prediction_weight=self.prediction_weight,
                ),
                num_envs=has.num_envs,
                episode_len=has.task.max_steps,
                refresh=self._relabel(pursued, above) if hindsight else None,
                refresh_reads=False,
            )

    def upper_learner(
        self, index: int, controller: MetaController, sub_controller: SubController, settings: LearnerSettings
    ) -> Learner:
        """What trains a level that chooses subgoals: one row for each of its options."""
        level, has = self.has.levels[index], self.has
        max_steps = has.task.max_steps
        largest_return, smallest_return = has.task.largest_extrinsic_return, has.task.smallest_extrinsic_return
        if level.pursues is not None:
            largest_return, smallest_return = self._rewards(index).largest_return, -math.inf
        steps, refresh = self._refresh_steps(index), None
        if steps is not None:
            refresh = partial(refresh_hidden, sub_controller, steps, read_last_observation=self.reads_last)
        with settings_named("meta" if level.pursues is None else "middle"):
            return Learner(
                controller,
                settings,
                extract=self._option_extract(index, controller, sub_controller, settings),
                loss=make_recurrent_loss(
                    controller,
                    settings,
                    gamma=self.gamma,
                    largest_return=largest_return,
                    smallest_return=smallest_return,
                    loss_keys={} if self.smdp_discount else {"steps": None},
                ),
                episode_len=None if max_steps is None else max_steps + 1,  # options, and a row that ends the episode
                refresh=refresh,
            )

    def _pursued_above(self, index: int) -> keys.OptionKeys | None:
        """Of the set that the level above pursues; ``None`` if that is the task, or there is no level above."""
        above = self.has.levels[index + 1 : index + 2]
        return None if not above or above[0].pursues is None else above[0].pursues.keys

    def _is_masked(self, index: int) -> bool:
        """Whether a level chooses among what is left, or worth choosing, only."""
        chosen, is_top = self.has.subgoals[index - 1], index == len(self.has.subgoals)
        repeatable = self.repeatable_subgoals if is_top and self.repeatable_subgoals is not None else chosen.repeatable
        return self.has.available_keys[index - 1] is not None or (self.mask_reached and not repeatable)

    def _rewards(self, index: int) -> IntrinsicReward:
        """What a level is paid for the subgoal that it pursues."""
        return IntrinsicReward(hazard=self.hazard_reward, wrong_subgoal=self.penalties[index])

    def _refresh_steps(self, index: int) -> int | None:
        """Steps of the longest options after which the state that a level reads is computed anew."""
        return self.refresh_hidden_steps if self.version == "v2" and index == 1 else None

    def _relabel(
        self, pursued: keys.OptionKeys, above: keys.OptionKeys | None
    ) -> Callable[[TensorDictBase], TensorDictBase]:
        return partial(
            relabel_subgoals,
            num_subgoals=self.has.levels[0].num_conditions,
            rewards=self._rewards(0),
            hazard_key=self.has.hazard_key,
            subgoal_key=pursued.subgoal,
            attained_key=pursued.attained,
            mask_key=pursued.subgoal_mask,
            option_init_key=pursued.option_init,
            option_done_key=pursued.option_done,
            option_terminated_key=pursued.option_terminated,
            upper_done_key=None if above is None else above.option_done,
            upper_terminated_key=None if above is None else above.option_terminated,
            intrinsic_reward_key=pursued.intrinsic_reward,
        )

    def _option_extract(
        self, index: int, controller: MetaController, sub_controller: SubController, settings: LearnerSettings
    ) -> Extract:
        """Where a level's rows come from: options as they were or, with hindsight, as they might have been, too."""
        level, names = self.has.levels[index], _keys_of(self.has.levels[index])
        at_end = partial(_read_last, sub_controller) if self.reads_last else None
        pursued: dict[str, Any] = {}
        if level.pursues is not None:
            above = level.pursues.keys
            pursued = {
                "init_key": above.option_init,
                "done_key": above.option_done,
                "terminated_key": above.option_terminated,
                "condition_key": above.subgoal,
                "active_condition_key": above.active_subgoal,
            }
        starts = [keys.IS_INIT] if settings.sampling in FROM_STARTS and pursued else []
        history_steps = self._refresh_steps(index)

        def extractor(active_subgoal_key: str) -> OptionExtractor:
            return OptionExtractor(
                input_keys=controller.input_keys,
                mask_key=controller.mask_key,
                subgoal_key=names.subgoal,
                option_init_key=names.option_init,
                option_done_key=names.option_done,
                option_steps_key=names.option_steps,
                option_return_key=names.option_return,
                active_subgoal_key=active_subgoal_key,
                at_end=at_end,
                state_keys=[*stored_states(controller, settings), *starts],
                history=None if history_steps is None else OptionHistory(history_steps),
                max_held=_held_options(self.has.task, settings),
                **pursued,
            )

        if not self.meta_hindsight:
            return extractor(names.active_subgoal)
        gamma = self.gamma if self.smdp_discount else 1.0
        as_told = extractor(keys.HINDSIGHT_SUBGOAL)
        return HindsightOptions(extractor(names.active_subgoal), as_told, gamma=gamma, at_start=at_end)


def _keys_of(level: Level) -> keys.OptionKeys:
    """Of the set of subgoals that a level chooses among."""
    assert level.choices is not None
    return level.choices.keys


def _keys_above(level: Level) -> keys.OptionKeys:
    """Of the set of subgoals that a level pursues."""
    assert level.pursues is not None
    return level.pursues.keys


def _state_keys(level: Level) -> tuple[str, str]:
    return f"{level.name}_hidden", f"{level.name}_cell"


def _ends(pursued: keys.OptionKeys) -> dict[str, str]:
    """What is stored of the critic's verdict, by what it is for the loss."""
    return {
        "reward": pursued.intrinsic_reward,
        "done": pursued.option_done,
        "terminated": pursued.option_terminated,
    }


def _held_options(task: Task, settings: LearnerSettings) -> int:
    """How many options of an episode wait for its end: all, unless it may be very long or have none.

    What waits can't be learned from yet. Sequences don't go over the border between two pieces of an episode, so these
    are several times as long.
    """
    if task.max_steps is not None and task.max_steps <= LONGEST_HELD_EPISODE:
        return LONGEST_HELD_EPISODE
    return 8 * ((settings.slice_len or 1) + settings.lookahead())


@torch.no_grad()
def _read_last(sub_controller: SubController, after: TensorDictBase) -> TensorDictBase:
    """Advances the LSTM state where episodes ended by their last observation."""
    hidden, cell = sub_controller.advance(after)
    return after.set(sub_controller.hidden_key, hidden).set(sub_controller.cell_key, cell)
