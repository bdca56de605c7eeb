"""Montezuma's Revenge, first screen (section IV-D of the paper): subgoals are places on the screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.emulators import Emulators, Snapshot
from hdrqn_torchrl.transforms import Window

Box = tuple[int, int, int, int]
"""Left, top, right and bottom in pixels of the 160x210 screen, the last two outside."""

BOXES: dict[str, Box] = {
    "middle_ladder_top": (68, 73, 92, 93),
    "middle_ladder_bottom": (70, 112, 90, 136),
    "rope": (107, 96, 118, 148),
    "bottom_right_ladder_top": (122, 116, 148, 139),
    "bottom_right_ladder_bottom": (128, 158, 144, 181),
    "bottom_left_ladder_top": (8, 124, 37, 139),
    "bottom_left_ladder_bottom": (14, 158, 30, 181),
    "key": (10, 100, 22, 124),
    "left_door": (16, 58, 31, 94),
    "right_door": (129, 58, 145, 94),
}
"""Where the agent's centre is when it is at a place. The left ones end early: those who fall off the conveyor belt pass
by on their right."""

SUBGOALS = (
    "middle_ladder_bottom",
    "bottom_right_ladder_bottom",
    "bottom_left_ladder_bottom",
    "key",
    "left_door",
    "right_door",
)
"""The paper's six."""

ALL_ACTIONS = tuple(range(18))
USEFUL_ACTIONS = (0, 1, 2, 3, 4, 5, 11, 12)
"""Nothing, jump, up, right, left, down, jump right, jump left; the other ten do the same in this game."""

_ROOM, _X, _Y, _POSE, _DYING, _INVENTORY, _OBJECTS, _FALLING = 3, 42, 43, 53, 55, 65, 66, 88  # bytes of the RAM
_DEAD_POSES = (22, 30)  # after a fall, by the skull; they last one step longer than _DYING
_FIRST_ROOM, _KEY, _KEY_IS_THERE = 1, 2, 1
_DOOR_SCORE = 300.0  # the key brings 100
_AGENT_COLORS = ((200, 72, 72), (210, 182, 86), (228, 111, 111))
_PLAYED_ROWS = slice(22, 181)  # below the score and the lives, which have the agent's colours
_LONGEST_DEATH = 40  # steps from an impact to the next life


class MontezumaEnv(EnvBase):
    """The first screen of Montezuma's Revenge as a batch of emulators.

    **Observation.** ``pixels`` ``[210, 160, 3]`` uint8, the native screen, and ``position`` ``[2]`` (x to the right, y
    down, in pixels), the agent's centre. :func:`make_montezuma` makes the agent's window of them.

    **Reward.** ``reward``: what the score rose by. ``extrinsic_reward``: 1 for the key and 1 for a door. Beside them:
    ``attained`` ``[G]`` (the agent came into a subgoal's box in this step, alive and not falling; took the key; at a
    reset: it begins there),
    ``available`` ``[G]`` (subgoals worth choosing: not where the agent is; not the key once it is taken), ``hazard``
    (the agent died in this step), ``success`` (a door was opened).

    **End of episode.** Terminated when a door opens, the room is left, the game is over or, if ``one_life``, the agent
    dies; truncated after ``max_steps`` steps.

    Args:
        num_envs: number of emulators N; it is the batch size ``[N]``.
        subgoals: names in :data:`BOXES`, or boxes by name.
        max_steps: step limit of an episode.
        frame_skip: frames of a step.
        sticky: probability that a frame repeats the previous action (Machado et al., 2018, use 0.25).
        actions: ALE's numbers of the actions the agent has; :data:`USEFUL_ACTIONS` are enough.
        one_life: an episode ends with the first death. Else the step in which the agent dies lasts until its next life.
        locator: where ``position`` comes from: ``"ram"`` or ``"pixels"`` (the agent's colours on the screen).
        noops: an episode begins with 0 to so many steps of doing nothing, drawn anew each time. Without them (and
            without sticky actions) the game is deterministic.
        practice: share of episodes that do not begin at the start but at a subgoal that was attained before, drawn
            among those. (Not in the paper.)
        practice_steps: steps of all emulators together after which there is no more practice; ``None``: never.
        threads: that step the emulators.
        seed: of no-ops, practice and sticky actions; ``None`` draws one from torch's global generator.
        device: device of all tensors.

    Raises:
        ImportError: if ale-py is missing.
        ValueError: if an argument breaks its rule.

    Examples:
        >>> env = MontezumaEnv(num_envs=2, seed=0)
        >>> env.rollout(3)["position"][0, 0].tolist()
        [79.5, 82.5]
    """

    batch_locked = True

    def __init__(
        self,
        num_envs: int = 8,
        *,
        subgoals: Sequence[str] | Mapping[str, Box] = SUBGOALS,
        max_steps: int = 500,
        frame_skip: int = 4,
        sticky: float = 0.0,
        actions: Sequence[int] = ALL_ACTIONS,
        one_life: bool = True,
        locator: Literal["ram", "pixels"] = "ram",
        noops: int = 0,
        practice: float = 0.0,
        practice_steps: int | None = None,
        threads: int = 1,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be >= 1, got {num_envs}; use 16 for training on one core.")
        if max_steps < 1:
            raise ValueError(f"max_steps must be >= 1, got {max_steps}; key and door take 167 steps.")
        if noops < 0:
            raise ValueError(f"noops must be >= 0, got {noops}; evaluations use 30.")
        if not 0.0 <= practice <= 1.0:
            raise ValueError(f"practice must lie in [0, 1], got {practice}; it is a share of episodes.")
        if locator not in ("ram", "pixels"):
            raise ValueError(f"locator must be 'ram' or 'pixels', got {locator!r}; 'ram' is exact.")
        if not actions or not set(actions) <= set(ALL_ACTIONS) or len(set(actions)) < len(actions):
            raise ValueError(
                f"actions must be different numbers from 0 to 17, got {list(actions)}; use USEFUL_ACTIONS."
            )
        super().__init__(device=torch.device(device or "cpu"), batch_size=(num_envs,))
        self.subgoals = _boxes_of(subgoals)
        self.num_envs, self.max_steps, self.actions, self.one_life = num_envs, max_steps, tuple(actions), one_life
        self.locator, self.noops, self.practice, self.practice_steps = locator, noops, practice, practice_steps
        self.emulators = Emulators("montezuma_revenge", num_envs, frame_skip=frame_skip, sticky=sticky, threads=threads)
        self.seen: tuple[int | None, int] | None = None
        """Side of the agent's window and of the image that is made of it, if that is known here; for pictures."""
        self.steps = np.zeros(num_envs, np.int64)
        self.total_steps = 0
        self._inside = np.zeros((num_envs, len(self.subgoals)), bool)  # boxes that the agents were in before the step
        self._practice_starts = _PracticeStarts()
        self._make_specs()
        self._generator = np.random.default_rng()
        self.set_seed(torch.randint(2**31, ()).item() if seed is None else seed)

    def _make_specs(self) -> None:
        n, device = self.num_envs, self.device

        def flag(size: int) -> Binary:
            return Binary(shape=(n, size), dtype=torch.bool, device=device)

        self.observation_spec = Composite(
            {
                keys.PIXELS: Bounded(
                    0, 255, shape=(n, *self.emulators.screens.shape[1:]), dtype=torch.uint8, device=device
                ),
                keys.POSITION: Unbounded(shape=(n, 2), dtype=torch.float32, device=device),
                keys.ATTAINED: flag(len(self.subgoals)),
                keys.AVAILABLE: flag(len(self.subgoals)),
                keys.HAZARD: flag(1),
                keys.SUCCESS: flag(1),
            },
            shape=(n,),
            device=device,
        )
        self.action_spec = Categorical(len(self.actions), shape=(n,), dtype=torch.int64, device=device)
        self.reward_spec = Composite(
            {key: Unbounded(shape=(n, 1), device=device) for key in (keys.REWARD, keys.EXTRINSIC_REWARD)},
            shape=(n,),
            device=device,
        )
        self.done_spec = Composite(
            {key: flag(1) for key in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)}, shape=(n,), device=device
        )

    def _set_seed(self, seed: int | None) -> None:
        self._generator = np.random.default_rng(seed or 0)
        self.emulators.seed(seed or 0)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        chosen = range(self.num_envs) if mask is None else mask.view(self.num_envs).nonzero().squeeze(-1).tolist()
        for index in chosen:
            self._begin(index)
        here = self._places()
        self._inside[list(chosen)] = here[list(chosen)]
        no = np.zeros(self.num_envs, bool)
        return self._tensordict(
            {
                **self._view(here),
                keys.ATTAINED: here,
                **dict.fromkeys((keys.HAZARD, keys.SUCCESS, keys.DONE, keys.TERMINATED, keys.TRUNCATED), no),
            }
        )

    def _begin(self, index: int) -> None:
        """A new episode in one emulator."""
        self.steps[index] = 0
        practises = self.practice_steps is None or self.total_steps < self.practice_steps
        if practises and self._practice_starts and self._generator.random() < self.practice:
            self.emulators.restore(index, self._practice_starts.draw(self._generator))
            return
        self.emulators.restore(index, self.emulators.start)
        if self.noops and (number := int(self._generator.integers(self.noops + 1))):
            self.emulators.act_alone(index, 0, number)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        had_key = self._has_key()
        chosen = tensordict.get(keys.ACTION).tolist()
        score = self.emulators.act([self.actions[action] for action in chosen])
        self.steps += 1
        self.total_steps += self.num_envs

        ram = self.emulators.ram
        died, opened, took_key = ram[:, _DYING] > 0, score >= _DOOR_SCORE, self._has_key() & ~had_key
        here = self._places()
        attained = here & ~self._inside
        if "key" in self.subgoals:
            attained[:, list(self.subgoals).index("key")] = took_key
        over = opened | (ram[:, _ROOM] != _FIRST_ROOM)
        if self.one_life:
            over |= died
        else:
            over |= np.array([dead and self._wait_for_next_life(index) for index, dead in enumerate(died)])
            here[died] = self._places()[died]
        if self.practice:
            for index, subgoal in np.argwhere(attained & ~over[:, None]):
                self._practice_starts.add(
                    (int(subgoal), bool(self._has_key()[index])), self.emulators.save(index), self._generator
                )
        self._inside = here
        truncated = (self.steps >= self.max_steps) & ~over
        return self._tensordict(
            {
                **self._view(here),
                keys.REWARD: score,
                keys.EXTRINSIC_REWARD: took_key.astype(np.float32) + opened,
                keys.ATTAINED: attained,
                keys.HAZARD: died,
                keys.SUCCESS: opened,
                keys.DONE: over | truncated,
                keys.TERMINATED: over,
                keys.TRUNCATED: truncated,
            }
        )

    def _wait_for_next_life(self, index: int) -> bool:
        """Does nothing while an agent dies; returns whether that was its last life."""
        for _ in range(_LONGEST_DEATH):
            if self.emulators.is_over(index) or self.emulators.ram[index, _POSE] not in _DEAD_POSES:
                break
            self.emulators.act_alone(index, 0)
        return self.emulators.is_over(index)

    def _has_key(self) -> NDArray[np.bool_]:
        return self.emulators.ram[:, _INVENTORY] == _KEY

    def positions(self) -> NDArray[np.float32]:
        """Centres of the agents, ``[N, 2]``."""
        if self.locator == "pixels":
            return np.stack([locate(screen) for screen in self.emulators.screens])
        ram = self.emulators.ram.astype(np.float32)
        return np.stack([ram[:, _X] + 2.5, 317.5 - ram[:, _Y]], -1)

    def _places(self) -> NDArray[np.bool_]:
        """Which boxes the agents are in, alive and not falling, ``[N, G]``."""
        ram, (x, y) = self.emulators.ram, self.positions().T[:, :, None]
        left, top, right, bottom = np.array(list(self.subgoals.values())).T
        inside = (left <= x) & (x < right) & (top <= y) & (y < bottom)
        well = (ram[:, _DYING] == 0) & (ram[:, _FALLING] == 0) & (ram[:, _ROOM] == _FIRST_ROOM)
        return inside & well[:, None]

    def _view(self, here: NDArray[np.bool_]) -> dict[str, NDArray]:
        available = ~here
        if "key" in self.subgoals:
            key = list(self.subgoals).index("key")
            available[:, key] = self.emulators.ram[:, _OBJECTS] & _KEY_IS_THERE != 0
        return {keys.PIXELS: self.emulators.screens, keys.POSITION: self.positions(), keys.AVAILABLE: available}

    def _tensordict(self, entries: Mapping[str, NDArray]) -> TensorDict:
        """Copies of the arrays, flat ones ``[N]`` as columns ``[N, 1]``."""
        tensors = {key: torch.tensor(array, device=self.device) for key, array in entries.items()}
        columns = {key: each.unsqueeze(-1) if each.ndim == 1 else each for key, each in tensors.items()}
        return TensorDict(columns, batch_size=self.batch_size, device=self.device)

    def state_dict(self, *args, **kwargs) -> dict[str, Any]:
        """Emulators, generators and episodes in progress: what a resumed run needs."""
        return {
            "emulators": [_encoded(self.emulators.save(i, with_random=True)) for i in range(self.num_envs)],
            "practice_starts": self._practice_starts.state_dict(),
            "steps": torch.tensor(self.steps),
            "total_steps": self.total_steps,
            "inside": torch.tensor(self._inside),
            "generator": self._generator.bit_generator.state,
        }

    def load_state_dict(self, state_dict: dict[str, Any], *args, **kwargs) -> None:
        """Restores what :meth:`state_dict` returned.

        Raises:
            ValueError: if it is the state of another number of emulators.
        """
        if len(state_dict["steps"]) != self.num_envs:
            raise ValueError(f"state_dict must hold {self.num_envs} emulators, got {len(state_dict['steps'])}.")
        for index, moment in enumerate(state_dict["emulators"]):
            self.emulators.restore(index, _decoded(moment))
        self._practice_starts.load_state_dict(state_dict["practice_starts"])
        self.steps, self._inside = state_dict["steps"].numpy().copy(), state_dict["inside"].numpy().copy()
        self.total_steps = state_dict["total_steps"]
        self._generator.bit_generator.state = state_dict["generator"]


class _PracticeStarts:
    """Moments in which subgoals were attained, some of each kind (which subgoal, with or without the key)."""

    def __init__(self, capacity: int = 16) -> None:
        self.capacity, self._moments = capacity, dict[tuple[int, bool], list[Snapshot]]()

    def __len__(self) -> int:
        return len(self._moments)

    def add(self, kind: tuple[int, bool], moment: Snapshot, generator: np.random.Generator) -> None:
        """Keeps a moment; where there are enough of its kind, in place of a random one."""
        moments = self._moments.setdefault(kind, [])
        if len(moments) < self.capacity:
            moments.append(moment)
        else:
            moments[generator.integers(self.capacity)] = moment

    def draw(self, generator: np.random.Generator) -> Snapshot:
        """A moment of a random kind."""
        kinds = sorted(self._moments)
        moments = self._moments[kinds[generator.integers(len(kinds))]]
        return moments[generator.integers(len(moments))]

    def state_dict(self) -> list[dict[str, Any]]:
        return [
            {"subgoal": subgoal, "key": key, "moments": [_encoded(moment) for moment in moments]}
            for (subgoal, key), moments in self._moments.items()
        ]

    def load_state_dict(self, state: list[dict[str, Any]]) -> None:
        self._moments = {
            (kind["subgoal"], kind["key"]): [_decoded(moment) for moment in kind["moments"]] for kind in state
        }


def _encoded(moment: Snapshot) -> dict[str, Tensor]:
    return {
        "state": torch.tensor(np.frombuffer(moment.state, np.uint8)),
        "ram": torch.tensor(moment.ram),
        "screen": torch.tensor(moment.screen),
    }


def _decoded(moment: Mapping[str, Tensor]) -> Snapshot:
    return Snapshot(moment["state"].numpy().tobytes(), moment["ram"].numpy().copy(), moment["screen"].numpy().copy())


def _boxes_of(subgoals: Sequence[str] | Mapping[str, Box]) -> dict[str, Box]:
    if isinstance(subgoals, Mapping):
        boxes = {str(name): tuple(int(side) for side in box) for name, box in subgoals.items()}
        for name, box in boxes.items():
            if len(box) != 4 or not (box[0] < box[2] and box[1] < box[3]):
                raise ValueError(f"subgoals.{name} must be left, top, right, bottom with an area, got {list(box)}.")
    else:
        if unknown := [name for name in subgoals if name not in BOXES]:
            raise ValueError(f"subgoals must be names among {list(BOXES)} or boxes by name, got {unknown[0]!r}.")
        boxes = {name: BOXES[name] for name in subgoals}
    if not boxes:
        raise ValueError("subgoals must hold at least one place, got none; leave them out for the paper's six.")
    return boxes  # type: ignore[return-value]


def locate(screen: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Centre of the agent on a screen ``[210, 160, 3]`` by its colours alone: x and y ``[2]``.

    Max-pooled, resized or grey screens do not have these colours. Without any of them, the centre of the screen.
    """
    played = screen[_PLAYED_ROWS]
    is_agent = np.zeros(played.shape[:2], bool)
    for color in _AGENT_COLORS:
        is_agent |= (played == np.array(color, np.uint8)).all(-1)
    rows, columns = np.flatnonzero(is_agent.any(1)), np.flatnonzero(is_agent.any(0))
    if not len(rows):
        return np.array([screen.shape[1] / 2, screen.shape[0] / 2], np.float32)
    center = [(columns[0] + columns[-1]) / 2, (rows[0] + rows[-1]) / 2 + _PLAYED_ROWS.start]
    return np.array(center, np.float32)


def make_montezuma(
    num_envs: int = 8,
    *,
    view: int | None = 70,
    size: int = 44,
    keep_pixels: bool = False,
    **settings: Any,
) -> TransformedEnv:
    """Montezuma's Revenge as the paper's agent sees it: through a window around it.

    Args:
        num_envs: number of emulators.
        view: side of the window in pixels of the screen, black beyond its edges; ``None``: the whole screen.
        size: side of the square image that it is resized to.
        keep_pixels: keep the whole screen beside it (100 kB for each step).
        settings: for :class:`MontezumaEnv`.

    Returns:
        An environment with ``observation`` ``[3, size, size]`` uint8 and the other keys of :class:`MontezumaEnv`.

    Examples:
        >>> env = make_montezuma(num_envs=2, seed=0)
        >>> env.rollout(3)["observation"].shape
        torch.Size([2, 3, 3, 44, 44])
    """
    env = MontezumaEnv(num_envs, **settings)
    env.seen = view, size
    return TransformedEnv(env, Window(view=view, size=size, keep_pixels=keep_pixels))
