"""The grid tasks as Gymnasium environments; importing this module registers their ids.

``hdrqn/Gridworld-v0`` is the open map; ``hdrqn/FourRooms-v0`` and ``hdrqn/NineRooms-v0`` have inner walls.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from torch import Tensor

from hdrqn_torchrl.envs.grid.drawing import draw_worlds
from hdrqn_torchrl.envs.grid.rules import ACTIONS, GridEvents, GridRules, GridState
from hdrqn_torchrl.envs.grid.task import ROOMS


class MultiGoalGymEnv(gymnasium.Env[np.ndarray, np.int64]):
    """One world of :class:`~hdrqn_torchrl.envs.MultiGoalGridEnv` for Gymnasium, equal to it step for step.

    **Actions.** 0 up, 1 down, 2 left, 3 right.

    **Observation.** ``[view, view]`` uint8 cell codes, agent in the centre: 0 floor, 1 wall or outside, 2 obstacle,
    3 + k goal k.

    **Reward.** -1 on an obstacle, +1 for each goal in order, 0.01 for a goal out of order.

    **Info.** ``extrinsic_reward`` (without the obstacle's penalty), ``attained`` (``[K]`` bool, goals reached by this
    step), ``hazard`` (obstacle hit), ``is_success`` (last goal reached, all in order). With ``places``:
    ``rooms_attained`` (the room or door entered, the goals reached by this step) and ``rooms_available`` (all but the
    place where the agent is; the goals that are left).

    **End of episode.** All goals collected: terminated. ``max_steps`` steps: truncated.

    Args:
        layout: ``"open"``, ``"four_rooms"``, ``"nine_rooms"``, or the rows of a map (``#`` is wall).
        num_goals: K >= 1.
        view: side of the window in cells (odd), or ``None`` for the whole map, agent-centred.
        max_steps: step limit of an episode.
        obstacle: ``"stay"`` or ``"teleport"`` (a hit obstacle moves to a random free cell).
        num_obstacles: number of obstacles.
        places: whether rooms and doors are nearer subgoals; ``None``: as the layout has it (``"nine_rooms"``: yes).
        render_mode: ``"rgb_array"`` or ``None``.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> import gymnasium
        >>> import hdrqn_torchrl.envs.gym
        >>> env = gymnasium.make("hdrqn/FourRooms-v0", num_goals=3, view=3, max_steps=100)
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape
        (3, 3)
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}

    def __init__(
        self,
        layout: str | Sequence[str] = "open",
        *,
        num_goals: int = 2,
        view: int | None = 5,
        max_steps: int = 50,
        obstacle: Literal["stay", "teleport"] = "stay",
        num_obstacles: int = 2,
        places: bool | None = None,
        render_mode: Literal["rgb_array"] | None = None,
    ) -> None:
        if max_steps < 1:
            raise ValueError(f"max_steps must be >= 1, got {max_steps}; use 50 for the paper's two-goal tasks.")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(
                f"render_mode must be 'rgb_array' or None, got {render_mode!r}; use 'rgb_array' for frames."
            )
        self.rules = GridRules(
            layout, num_goals=num_goals, view=view, obstacle=obstacle, num_obstacles=num_obstacles, places=places
        )
        self.max_steps, self.render_mode = max_steps, render_mode
        window = (self.rules.view, self.rules.view)
        self.observation_space = gymnasium.spaces.Box(0, self.rules.num_codes - 1, window, np.uint8)
        self.action_space = gymnasium.spaces.Discrete(len(ACTIONS))
        self.state: GridState | None = None
        self.steps = 0
        self._generator: torch.Generator | None = None

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: seed of this and the following worlds; ``None`` goes on with the present one.
            options: ``None`` draws a random world. ``{"agent": cell, "objects": cells}`` sets it: flat cell indices
                (``row * width + column``) of the agent, and of the obstacles followed by goals 0..K-1.

        Returns:
            Observation ``[view, view]`` uint8 and info.

        Raises:
            ValueError: if the options lack a key, have an unknown one, or do not describe a world.
        """
        super().reset(seed=seed)
        if seed is not None or self._generator is None:
            self._generator = torch.Generator().manual_seed(int(self.np_random.integers(2**31)))
        self.state = self._place(options) if options else self.rules.sample(1, self._generator)
        self.steps = 0
        none = torch.zeros(1)
        never, attained = none.bool(), torch.zeros((1, self.rules.num_goals), dtype=torch.bool)
        events = GridEvents(none, none, never, attained, never, never)
        return self._observation(), self._info(self.state.agent, events)

    def step(self, action: np.int64 | int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Moves the agent once.

        Args:
            action: 0 up, 1 down, 2 left, 3 right.

        Returns:
            Observation, reward, terminated, truncated and info.

        Raises:
            ValueError: if the action is none of the four.
            gymnasium.error.ResetNeeded: if no episode was started.
        """
        if self.state is None:
            raise gymnasium.error.ResetNeeded("step needs an episode; call reset() first.")
        if not self.action_space.contains(action):
            raise ValueError(f"action must be an integer from 0 to {len(ACTIONS) - 1} {ACTIONS}, got {action!r}.")
        before = self.state.agent
        self.state, events = self.rules.step(self.state, torch.tensor([int(action)]), self._generator)
        self.steps += 1
        terminated = bool(events.all_collected)
        truncated = self.steps >= self.max_steps and not terminated
        return self._observation(), events.reward.item(), terminated, truncated, self._info(before, events)

    def render(self) -> np.ndarray | None:
        """Draws the map, dimmed where the agent does not see it: ``[height, width, 3]`` uint8, or None without mode."""
        if self.render_mode is None:
            return None
        if self.state is None:
            raise gymnasium.error.ResetNeeded("render needs an episode; call reset() first.")
        return draw_worlds(self.rules, self.state)[0].numpy()

    def _place(self, options: Mapping[str, Any]) -> GridState:
        if set(options) != {"agent", "objects"}:
            raise ValueError(
                f"options must have the keys 'agent' and 'objects', got {sorted(options)}; give both or none."
            )
        agent, objects = torch.as_tensor(options["agent"]), torch.as_tensor(options["objects"])
        return self.rules.place(agent.reshape(1), objects.reshape(1, -1))

    def _observation(self) -> np.ndarray:
        assert self.state is not None
        return self.rules.observe(self.state)[0].numpy()

    def _info(self, before: Tensor, events: GridEvents) -> dict[str, Any]:
        assert self.state is not None
        info = {
            "extrinsic_reward": events.extrinsic_reward.item(),
            "attained": events.attained[0].numpy(),
            "hazard": bool(events.hazard),
            "is_success": bool(events.success),
        }
        if self.rules.places is not None:
            attained, available = self.rules.near_subgoals(before, self.state, events.attained)
            info[ROOMS.attained], info[ROOMS.available] = attained[0].numpy(), available[0].numpy()
        return info


_ENTRY_POINT = f"{__name__}:{MultiGoalGymEnv.__name__}"  # as a string, so that specs can be written as JSON
gymnasium.register(id="hdrqn/Gridworld-v0", entry_point=_ENTRY_POINT, kwargs={"layout": "open"})
gymnasium.register(id="hdrqn/FourRooms-v0", entry_point=_ENTRY_POINT, kwargs={"layout": "four_rooms"})
gymnasium.register(id="hdrqn/NineRooms-v0", entry_point=_ENTRY_POINT, kwargs={"layout": "nine_rooms", "max_steps": 150})
