"""Montezuma's Revenge, first screen (section IV-D of the paper): subgoals are places on the screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.devices import to_device
from hdrqn_torchrl.envs.montezuma.emulators import Emulators, Snapshot
from hdrqn_torchrl.envs.montezuma.practice import PracticeStarts
from hdrqn_torchrl.envs.montezuma.screen import (
    ALL_ACTIONS,
    DOOR_SCORE,
    DOORS,
    SUBGOALS,
    Box,
    Ram,
    boxes_of,
    locate,
)
from hdrqn_torchrl.envs.montezuma.task import check_settings, montezuma_task
from hdrqn_torchrl.envs.specs import episode_ends, flags, rewards

_LONGEST_DEATH = 160  # frames from an impact to the next life


class MontezumaEnv(EnvBase):
    """The first screen of Montezuma's Revenge as a batch of emulators.

    **Observation.** ``pixels`` ``[210, 160, 3]`` uint8, the native screen, and ``position`` ``[2]`` (x to the right, y
    down, in pixels), the agent's centre. :func:`~hdrqn_torchrl.envs.make_montezuma` makes the agent's window of them.

    **Reward.** ``reward``: increase of the score. ``extrinsic_reward``: 1 for the key and 1 for a door. Besides these:
    ``attained`` ``[G]`` (the agent came into a subgoal's box in this step, alive and not falling; took the key; opened
    the door; at a reset: it begins there), ``available`` ``[G]`` (subgoals worth choosing: not where the agent is, but
    for a door that it has the key for; not the key once it is taken), ``hazard`` (the agent died in this step),
    ``success`` (a door was opened).

    **End of episode.** Terminated when a door opens, the room is left, the game is over or, if ``one_life``, the agent
    dies; truncated after ``max_steps`` steps.

    Args:
        num_envs: number of emulators N; it is the batch size ``[N]``.
        subgoals: names in :data:`~hdrqn_torchrl.envs.montezuma.screen.BOXES`, or boxes by name.
        key_and_door: the key and a door, whichever opens, are a farther set of subgoals than those places. It has the
            entries ``attained`` and ``available``; those of the places are then ``places_attained``,
            ``places_available``.
        max_steps: step limit of an episode.
        frame_skip: frames of a step.
        sticky: probability that a frame repeats the previous action (Machado et al., 2018, use 0.25).
        actions: ALE's numbers of the actions the agent has; :data:`USEFUL_ACTIONS` are enough.
        one_life: an episode ends with the first death. Else the step in which the agent dies lasts until its next life.
        locator: where ``position`` comes from: ``"ram"`` or ``"pixels"`` (the agent's colours on the screen).
        noops: an episode begins with a random number of steps of doing nothing, at most this many. Without them (and
            without sticky actions) the game is deterministic.
        practice: share of episodes that do not begin at the start but at a subgoal that was attained before, drawn
            among those. (Not in the paper.)
        practice_steps: steps of all emulators of this environment together after which practice ends; ``None``: never.
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
        key_and_door: bool = False,
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
        check_settings(
            num_envs=num_envs, max_steps=max_steps, noops=noops, practice=practice, locator=locator, actions=actions
        )
        super().__init__(device=torch.device(device or "cpu"), batch_size=(num_envs,))
        self.subgoals, self.key_and_door = boxes_of(subgoals), key_and_door
        self._near = keys.OptionKeys("places" if key_and_door else "")
        self.num_envs, self.max_steps, self.action_numbers = num_envs, max_steps, tuple(actions)
        self.one_life = one_life
        self.locator, self.noops, self.practice, self.practice_steps = locator, noops, practice, practice_steps
        self._longest_death = -(-_LONGEST_DEATH // frame_skip)
        self.emulators = Emulators("montezuma_revenge", num_envs, frame_skip=frame_skip, sticky=sticky, threads=threads)
        self.ram = Ram(self.emulators.ram)
        self._is_door = np.array([name in DOORS for name in self.subgoals])
        self.task = montezuma_task(
            tuple(self.subgoals),
            self.action_numbers,
            prefix=self._near.prefix,
            key_and_door=key_and_door,
            max_steps=max_steps,
        )
        self.seen: tuple[int | None, int] | None = None
        """Side of the agent's window and of the image that is made of it, if that is known here; for pictures."""
        self.steps = np.zeros(num_envs, np.int64)
        self.total_steps = 0
        self._inside = np.zeros((num_envs, len(self.subgoals)), bool)  # boxes that the agents were in before the step
        self._practice_starts = PracticeStarts()
        self._make_specs()
        self._generator = np.random.default_rng()
        self.set_seed(torch.randint(2**31, ()).item() if seed is None else seed)

    def _make_specs(self) -> None:
        n, device = self.num_envs, self.device

        self.observation_spec = Composite(
            {
                keys.PIXELS: Bounded(
                    0, 255, shape=(n, *self.emulators.screens.shape[1:]), dtype=torch.uint8, device=device
                ),
                keys.POSITION: Unbounded(shape=(n, 2), dtype=torch.float32, device=device),
                **{
                    key: flags(n, len(each), device=device)
                    for each in self.task.subgoals
                    for key in (each.keys.attained, each.keys.available)
                },
                keys.HAZARD: flags(n, 1, device=device),
                keys.SUCCESS: flags(n, 1, device=device),
            },
            shape=(n,),
            device=device,
        )
        self.action_spec = Categorical(len(self.action_numbers), shape=(n,), dtype=torch.int64, device=device)
        self.reward_spec = rewards(n, device=device)
        self.done_spec = episode_ends(n, device=device)

    def _set_seed(self, seed: int | None) -> None:
        """Starts everything over, practice as well: what is drawn from here on depends on ``seed`` alone."""
        self._generator = np.random.default_rng(seed or 0)
        self.emulators.seed(seed or 0)
        self._practice_starts, self.total_steps = PracticeStarts(), 0

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
                self._near.attained: here,
                **self._far(keys.ATTAINED, no, no),
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
        had_key = self.ram.has_key()
        chosen = tensordict.get(keys.ACTION).tolist()
        score = self.emulators.act([self.action_numbers[action] for action in chosen])
        self.steps += 1
        self.total_steps += self.num_envs

        has_key = self.ram.has_key()
        died, opened, took_key = self.ram.dying(), score >= DOOR_SCORE, has_key & ~had_key
        here = self._places()
        attained = here & ~self._inside
        if "key" in self.subgoals:
            attained[:, list(self.subgoals).index("key")] = took_key
        attained |= here & opened[:, None] & self._is_door
        over = opened | ~self.ram.in_first_room()
        if self.one_life:
            over |= died
        else:
            over |= np.array([dead and self._wait_for_next_life(index) for index, dead in enumerate(died)])
            here[died] = self._places()[died]
        if self.practice:
            for index, subgoal in np.argwhere(attained & ~over[:, None]):
                kind = int(subgoal), bool(has_key[index])
                self._practice_starts.add(kind, self.emulators.save(index), self._generator)
        self._inside = here
        truncated = (self.steps >= self.max_steps) & ~over
        return self._tensordict(
            {
                **self._view(here),
                keys.REWARD: score,
                keys.EXTRINSIC_REWARD: took_key.astype(np.float32) + opened,
                self._near.attained: attained,
                **self._far(keys.ATTAINED, took_key, opened),
                keys.HAZARD: died,
                keys.SUCCESS: opened,
                keys.DONE: over | truncated,
                keys.TERMINATED: over,
                keys.TRUNCATED: truncated,
            }
        )

    def _wait_for_next_life(self, index: int) -> bool:
        """Does nothing while an agent dies; returns whether that was its last life."""
        for _ in range(self._longest_death):
            if self.emulators.is_over(index) or not self.ram.lies_dead()[index]:
                break
            self.emulators.act_alone(index, 0)
        return self.emulators.is_over(index)

    def positions(self) -> NDArray[np.float32]:
        """Centres of the agents, ``[N, 2]``."""
        if self.locator == "pixels":
            return np.stack([locate(screen) for screen in self.emulators.screens])
        return self.ram.positions()

    def _places(self) -> NDArray[np.bool_]:
        """Which boxes the agents are in, alive and not falling, ``[N, G]``."""
        x, y = self.positions().T[:, :, None]
        left, top, right, bottom = np.array(list(self.subgoals.values())).T
        inside = (left <= x) & (x < right) & (top <= y) & (y < bottom)
        well = self.ram.in_first_room() & ~self.ram.dying() & ~self.ram.falling()
        return inside & well[:, None]

    def _view(self, here: NDArray[np.bool_]) -> dict[str, NDArray]:
        available = ~here
        if "key" in self.subgoals:
            key = list(self.subgoals).index("key")
            available[:, key] = self.ram.key_is_there()
        available |= self.ram.has_key()[:, None] & self._is_door
        return {
            keys.PIXELS: self.emulators.screens,
            keys.POSITION: self.positions(),
            self._near.available: available,
            **self._far(keys.AVAILABLE, self.ram.key_is_there(), np.ones(self.num_envs, bool)),
        }

    def _far(self, entry: str, key: NDArray[np.bool_], door: NDArray[np.bool_]) -> dict[str, NDArray[np.bool_]]:
        """An entry of the farther set of subgoals ``[N, 2]``, if there is one."""
        return {entry: np.stack([key, door], -1)} if self.key_and_door else {}

    def _tensordict(self, entries: Mapping[str, NDArray]) -> TensorDict:
        """Copies of the arrays, flat ones ``[N]`` as columns ``[N, 1]``."""
        tensors = {key: to_device(torch.tensor(array), self.device) for key, array in entries.items()}
        columns = {key: each.unsqueeze(-1) if each.ndim == 1 else each for key, each in tensors.items()}
        return TensorDict(columns, batch_size=self.batch_size, device=self.device)

    def state_dict(self, *args, **kwargs) -> dict[str, Any]:
        """Emulators, generators and episodes in progress: what a resumed run needs."""
        return {
            "emulators": [self.emulators.save(i, with_random=True).tensors() for i in range(self.num_envs)],
            "practice_starts": self._practice_starts.state_dict(),
            "steps": torch.tensor(self.steps),
            "total_steps": self.total_steps,
            "inside": torch.tensor(self._inside),
            "generator": self._generator.bit_generator.state,
        }

    def load_state_dict(self, state_dict: dict[str, Any], strict: bool = True) -> None:
        """Restores what :meth:`state_dict` returned.

        Args:
            state_dict: that.
            strict: ``False``: nothing is restored where the state is not whole. (TorchRL's ``EnvCreator`` hands one
                over that it has taken the tensors out of.)

        Raises:
            ValueError: if it is the state of another number of emulators.
        """
        if not strict and "steps" not in state_dict:
            return
        if len(state_dict["steps"]) != self.num_envs:
            raise ValueError(f"state_dict must hold {self.num_envs} emulators, got {len(state_dict['steps'])}.")
        for index, moment in enumerate(state_dict["emulators"]):
            self.emulators.restore(index, Snapshot.of_tensors(moment))
        self._practice_starts.load_state_dict(state_dict["practice_starts"])
        self.steps, self._inside = (state_dict[name].cpu().numpy().copy() for name in ("steps", "inside"))
        self.total_steps = state_dict["total_steps"]
        self._generator.bit_generator.state = state_dict["generator"]
