"""Natively batched TorchRL environment for the paper's grid tasks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.data import Categorical, Composite
from torchrl.envs import EnvBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.devices import on_host
from hdrqn_torchrl.envs.grid.rules import ACTIONS, GridEvents, GridRules, GridState
from hdrqn_torchrl.envs.grid.task import ROOMS, grid_task
from hdrqn_torchrl.envs.specs import episode_ends, flags, rewards


class MultiGoalGridEnv(EnvBase):
    """Goals to be reached in order on a grid, seen through a window around the agent (section IV of the paper).

    **Description.** Agent, two obstacles and K goals stand on distinct random free cells of an 11x11 map
    ("open", or "four_rooms" with inner walls and four doors). "nine_rooms" has 17x17 cells, 3x3 rooms and twelve doors;
    there all goals lie in other rooms than the agent's start. ``num_envs`` worlds step together as tensors.

    **Actions.** 0 up, 1 down, 2 left, 3 right; a wall stops the move.

    **Observation.** ``observation`` ``[view, view]`` uint8 cell codes, agent in the centre: 0 floor, 1 wall or
    outside, 2 obstacle, 3 + k goal k.

    **Reward.** ``reward``: -1 on an obstacle, +1 for each goal in order, 0.01 for a goal out of order.
    ``extrinsic_reward``: the same without the obstacle's penalty. Besides these: ``attained`` ``[K]`` (goals
    reached by this step), ``hazard`` (obstacle hit), ``success`` (last goal reached, all in order).
    With ``places`` there are also nearer subgoals, rooms, doors and the goals: ``rooms_attained`` (the room or door
    entered, the goals reached by this step) and ``rooms_available`` (all but the place where the agent is; the goals
    that are left); ``task.subgoals`` has their names.

    **End of episode.** All goals collected: terminated. ``max_steps`` steps: truncated.

    Args:
        num_envs: number of worlds N; it is the batch size ``[N]``.
        layout: ``"open"``, ``"four_rooms"``, ``"nine_rooms"``, or the rows of a map (``#`` is wall).
        num_goals: K >= 1.
        view: side of the window in cells (odd), or ``None`` for the whole map, agent-centred.
        max_steps: step limit of an episode.
        obstacle: ``"stay"`` or ``"teleport"`` (a hit obstacle moves to a random free cell).
        num_obstacles: number of obstacles.
        places: whether rooms and doors are nearer subgoals; ``None``: as the layout has it (``"nine_rooms"``: yes).
        seed: seed of the layouts; ``None`` draws one from torch's global generator.
        device: device of all tensors.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> env = MultiGoalGridEnv(num_envs=4, layout="four_rooms", seed=0)
        >>> rollout = env.rollout(3, break_when_any_done=False)
        >>> rollout["observation"].shape
        torch.Size([4, 3, 5, 5])
    """

    batch_locked = True

    def __init__(
        self,
        num_envs: int = 64,
        *,
        layout: str | Sequence[str] = "open",
        num_goals: int = 2,
        view: int | None = 5,
        max_steps: int = 50,
        obstacle: Literal["stay", "teleport"] = "stay",
        num_obstacles: int = 2,
        places: bool | None = None,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be >= 1, got {num_envs}; use 64 for training on one core.")
        if max_steps < 1:
            raise ValueError(f"max_steps must be >= 1, got {max_steps}; use 50 for the paper's two-goal tasks.")
        device = torch.device(device or "cpu")
        super().__init__(device=device, batch_size=(num_envs,))
        self.rules = GridRules(
            layout,
            num_goals=num_goals,
            view=view,
            obstacle=obstacle,
            num_obstacles=num_obstacles,
            places=places,
            device=device,
        )
        self.num_envs, self.max_steps = num_envs, max_steps
        self.settings: dict[str, Any] = {
            "layout": layout,
            "num_goals": num_goals,
            "view": view,
            "max_steps": max_steps,
            "obstacle": obstacle,
            "num_obstacles": num_obstacles,
        }
        self.task = grid_task(self.rules, self.settings)
        self._make_specs()
        self._generator = torch.Generator(device)
        self.set_seed(torch.randint(2**31, ()).item() if seed is None else seed)
        self.state = self.rules.sample(num_envs, self._generator)
        self.steps = torch.zeros(num_envs, dtype=torch.int64, device=device)

    def _make_specs(self) -> None:
        n, view, goals, device = self.num_envs, self.rules.view, self.rules.num_goals, self.device

        cells = Categorical(self.rules.num_codes, shape=(n, view, view), dtype=torch.uint8, device=device)
        places = (
            {}
            if self.rules.places is None
            else {key: flags(n, len(self.rules.near_names), device=device) for key in (ROOMS.attained, ROOMS.available)}
        )
        self.observation_spec = Composite(
            {
                keys.OBSERVATION: cells,
                keys.ATTAINED: flags(n, goals, device=device),
                keys.HAZARD: flags(n, 1, device=device),
                keys.SUCCESS: flags(n, 1, device=device),
                **places,
            },
            shape=(n,),
            device=device,
        )
        self.action_spec = Categorical(len(ACTIONS), shape=(n,), dtype=torch.int64, device=device)
        self.reward_spec = rewards(n, device=device)
        self.done_spec = episode_ends(n, device=device)

    def _set_seed(self, seed: int | None) -> None:
        self._generator.manual_seed(0 if seed is None else seed)

    def set_world(self, agent: Tensor, objects: Tensor) -> TensorDictBase:
        """Starts an episode in a chosen world instead of a random one.

        Args:
            agent: flat cell index of each agent, ``[N]`` int64.
            objects: flat cell indices of obstacles, then goals 0..K-1, ``[N, num_obstacles + K]`` int64.

        Returns:
            What :meth:`reset` would return.

        Raises:
            ValueError: if a shape is wrong, something stands on a wall, or two things share a cell.
        """
        if len(agent) != self.num_envs:
            raise ValueError(f"agent must have one cell for each of the {self.num_envs} worlds, got {len(agent)}.")
        state = self.rules.place(agent, objects)
        tensordict = self.reset()
        self.state = state
        near = self._near(state.agent, tensordict[keys.ATTAINED])
        return tensordict.update({keys.OBSERVATION: self.rules.observe(state), **near})

    def _reset(self, tensordict: TensorDictBase | None, **kwargs) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            self.state = self.rules.sample(self.num_envs, self._generator)
            self.steps = torch.zeros_like(self.steps)
        else:
            self._renew(mask.view(self.num_envs))
        flag = torch.zeros((self.num_envs, 1), dtype=torch.bool, device=self.device)
        no_goals = flag.repeat(1, self.rules.num_goals)
        return TensorDict(
            {
                keys.OBSERVATION: self.rules.observe(self.state),
                keys.ATTAINED: no_goals,
                keys.HAZARD: flag,
                keys.SUCCESS: flag.clone(),
                keys.DONE: flag.clone(),
                keys.TERMINATED: flag.clone(),
                keys.TRUNCATED: flag.clone(),
                **self._near(self.state.agent, no_goals),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _renew(self, ended: Tensor) -> None:
        """New worlds where ``ended`` ``[N]``. A GPU draws them for all rather than wait for their number."""
        self.steps = self.steps.masked_fill(ended, 0)
        if on_host(ended):
            rows = ended.nonzero().squeeze(-1)
            fresh = self.rules.sample(len(rows), self._generator)
            self.state = GridState(*(old.index_copy(0, rows, new) for old, new in zip(self.state, fresh, strict=True)))
            return
        fresh = self.rules.sample(self.num_envs, self._generator)
        kept = zip(self.state, fresh, strict=True)
        self.state = GridState(*(torch.where(expand_as_right(ended, old), new, old) for old, new in kept))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        before = self.state.agent
        self.state, events = self.rules.step(self.state, tensordict.get(keys.ACTION), self._generator)
        self.steps = self.steps + 1
        return self._outcome(before, events)

    def _near(self, before: Tensor, goals: Tensor) -> dict[str, Tensor]:
        """Entries of nearer subgoals, if there are any, after a step from ``before`` that reached ``goals``."""
        if self.rules.places is None:
            return {}
        attained, available = self.rules.near_subgoals(before, self.state, goals)
        return {ROOMS.attained: attained, ROOMS.available: available}

    @property
    def worlds(self) -> dict[str, Tensor]:
        """All that goes on from step to step, by name; to be set as a whole."""
        return {**self.state._asdict(), "steps": self.steps}

    @worlds.setter
    def worlds(self, worlds: dict[str, Tensor]) -> None:
        self.state = GridState(*(worlds[name] for name in GridState._fields))
        self.steps = worlds["steps"]

    @property
    def generators(self) -> list[torch.Generator]:
        """What steps and resets draw from."""
        return [self._generator]

    def state_dict(self, *args, **kwargs) -> dict[str, Tensor]:
        """All worlds and the generator of their layouts: what a resumed run needs."""
        return {**self.worlds, "generator": self._generator.get_state()}

    def load_state_dict(self, state_dict: dict[str, Tensor], strict: bool = True) -> None:
        """Restores what :meth:`state_dict` returned.

        Args:
            state_dict: that.
            strict: ``False``: nothing is restored where the state is not whole. (TorchRL's ``EnvCreator`` hands one
                over that it has taken the tensors out of.)

        Raises:
            ValueError: if it is the state of another number of worlds, or of impossible worlds.
        """
        if not strict and "steps" not in state_dict:
            return
        if len(state_dict["steps"]) != self.num_envs:
            raise ValueError(f"state_dict must hold {self.num_envs} worlds, got {len(state_dict['steps'])}.")
        state = GridState(*(state_dict[name].to(self.device) for name in GridState._fields))
        self._check_state(state, state_dict["steps"])
        self.state = state
        self.steps = state_dict["steps"].to(self.device)
        self._generator.set_state(state_dict["generator"].cpu())

    def _check_state(self, state: GridState, steps: Tensor) -> None:
        """Refuses cells beyond the map: the tables are read there without a check."""
        for name, cells, last in (("agent", state.agent, 0), ("objects", state.objects, 1)):
            own, inside = getattr(self.state, name), (cells >= 0) & (cells < self.rules.nowhere + last)
            if (cells.dtype, cells.shape) != (own.dtype, own.shape) or not inside.all():
                raise ValueError(
                    f"{name} must be {own.dtype} {list(own.shape)} of cells of the map, got {cells.dtype} "
                    f"{list(cells.shape)} from {int(cells.min())} to {int(cells.max())}; use another checkpoint."
                )
        for name, found, own in (("in_order", state.in_order, self.state.in_order), ("steps", steps, self.steps)):
            if (found.dtype, found.shape) != (own.dtype, own.shape) or (found < 0).any():
                raise ValueError(f"{name} must be like {own.dtype} {list(own.shape)}; use another checkpoint.")

    def _outcome(self, before: Tensor, events: GridEvents) -> TensorDictBase:
        terminated = events.all_collected
        truncated = (self.steps >= self.max_steps) & ~terminated
        columns = {
            keys.REWARD: events.reward,
            keys.EXTRINSIC_REWARD: events.extrinsic_reward,
            keys.HAZARD: events.hazard,
            keys.SUCCESS: events.success,
            keys.DONE: terminated | truncated,
            keys.TERMINATED: terminated,
            keys.TRUNCATED: truncated,
        }
        outcome = {key: column.unsqueeze(-1) for key, column in columns.items()}
        outcome[keys.OBSERVATION] = self.rules.observe(self.state)
        outcome[keys.ATTAINED] = events.attained
        outcome.update(self._near(before, events.attained))
        return TensorDict(outcome, batch_size=self.batch_size, device=self.device)
