"""What is stored of each step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict import NestedKey, TensorDictBase

from hdrqn_torchrl import keys


class StepSelector:
    """Keeps of collected steps ``[N, T]`` what the sub-controller (or a flat agent) learns from.

    What a step led to is what the next one starts from, so observations are kept from the root only.

    Args:
        root_keys: entries kept from the root.
        next_keys: entries kept from ``"next"``, besides the ends of the episode.
        subgoal_key: if given, the subgoal in force at each step is stored under this name (in a policy's raw output
            this entry is a mere proposal).
        active_subgoal_key: where the environment wrote the subgoal in force.
        option_limit: if given, ``eligible`` is stored: false for the last of so many steps that an option may have.
            Where it fails there, what would follow is unknown; to learn only where it succeeds would bias values.
        option_steps_key: where the environment wrote how long an option has lasted.
        traj_key: number of the episode.

    Examples:
        >>> import torch
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> steps = MultiGoalGridEnv(num_envs=2).rollout(5, break_when_any_done=False)
        >>> steps["collector", "traj_ids"] = torch.arange(2)[:, None].expand(2, 5)
        >>> stored = StepSelector(root_keys=["observation", "action"], next_keys=["reward"])(steps)
        >>> sorted(stored.keys()), sorted(stored["next"].keys())
        (['action', 'collector', 'next', 'observation'], ['done', 'reward', 'terminated', 'truncated'])
    """

    def __init__(
        self,
        *,
        root_keys: Sequence[NestedKey],
        next_keys: Sequence[NestedKey],
        subgoal_key: NestedKey | None = None,
        active_subgoal_key: NestedKey = keys.ACTIVE_SUBGOAL,
        option_limit: int | None = None,
        option_steps_key: NestedKey = keys.OPTION_STEPS,
        traj_key: NestedKey = keys.TRAJ_IDS,
    ) -> None:
        self.root_keys, self.subgoal_key, self.active_subgoal_key = list(root_keys), subgoal_key, active_subgoal_key
        self.next_keys = [*next_keys, keys.DONE, keys.TERMINATED]
        self.option_limit, self.option_steps_key = option_limit, option_steps_key
        self.traj_key = traj_key

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns steps ``[N, T]``."""
        steps, after = batch.select(*self.root_keys, self.traj_key), batch.get("next")
        if self.subgoal_key is not None:
            steps.set(self.subgoal_key, after.get(self.active_subgoal_key))
        if self.option_limit is not None:
            steps.set(keys.ELIGIBLE, after.get(self.option_steps_key) < self.option_limit)
        truncated = [keys.TRUNCATED] if keys.TRUNCATED in after else []  # not every environment has it
        return steps.set("next", after.select(*self.next_keys, *truncated))

    def reset(self) -> None:
        """Forgets nothing: it looks at one batch at a time."""

    def state_dict(self) -> dict[str, Any]:
        """Nothing, likewise."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes what :meth:`state_dict` returned."""
