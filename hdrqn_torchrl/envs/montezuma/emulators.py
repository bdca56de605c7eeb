"""Atari emulators stepped side by side, writing straight into numpy arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

if TYPE_CHECKING:
    from ale_py import ALEInterface

Bytes = NDArray[np.uint8]
LONGEST_STATE = 1 << 16  # bytes; the game's takes a few hundred


class Snapshot(NamedTuple):
    """An emulator at one moment."""

    state: bytes
    """As ale-py serialises it."""
    ram: Bytes
    """``[128]``"""
    screen: Bytes
    """``[210, 160, 3]``; an emulator that is put back does not draw it again by itself."""

    def tensors(self) -> dict[str, Tensor]:
        """Itself as a checkpoint holds it."""
        state = np.frombuffer(self.state, np.uint8)
        return {"state": torch.tensor(state), "ram": torch.tensor(self.ram), "screen": torch.tensor(self.screen)}

    @classmethod
    def of_tensors(cls, tensors: Mapping[str, Tensor]) -> Snapshot:
        """What :meth:`tensors` was called on.

        Raises:
            ValueError: if they are not the tensors of an emulator.
        """
        shapes = {name: tuple(tensors[name].shape) for name in cls._fields}
        only_bytes = all(tensors[name].dtype == torch.uint8 for name in cls._fields)
        fits = len(shapes["state"]) == 1 and 0 < shapes["state"][0] <= LONGEST_STATE
        if not (only_bytes and fits and shapes["ram"] == (128,) and shapes["screen"] == (210, 160, 3)):
            raise ValueError(f"a stored emulator must be bytes of a state, a RAM and a screen, got {shapes}.")
        state, ram, screen = (tensors[name].cpu().numpy() for name in cls._fields)
        return cls(state.tobytes(), ram.copy(), screen.copy())


class Emulators:
    """N emulators of one game whose RAM and screens lie in two arrays.

    Args:
        game: name of the ROM, as ale-py knows it.
        number: N.
        frame_skip: frames that an action lasts.
        sticky: probability that a frame repeats the previous action instead.
        threads: threads that step the emulators, each its share of them; ale-py releases Python's lock meanwhile.

    Raises:
        ImportError: if ale-py is missing.
        ValueError: if an argument breaks its rule.
    """

    def __init__(self, game: str, number: int, *, frame_skip: int = 4, sticky: float = 0.0, threads: int = 1) -> None:
        try:
            from ale_py import ALEInterface, LoggerMode, roms
        except ImportError as error:
            raise ImportError("Atari games need ale-py: pip install 'hdrqn_torchrl[atari]'.") from error
        for name, value in (("number", number), ("frame_skip", frame_skip), ("threads", threads)):
            if value < 1:
                raise ValueError(f"{name} must be >= 1, got {value}.")
        if not 0.0 <= sticky < 1.0:
            raise ValueError(f"sticky must lie in [0, 1), got {sticky}; 0.25 is usual, 0 turns it off.")
        ALEInterface.setLoggerMode(LoggerMode.Error)
        rom = roms.get_rom_path(game)
        if rom is None:
            raise ValueError(f"game must be one that ale-py has a ROM of, got {game!r}.")
        self._rom, self._sticky = rom, sticky
        self._emulators: list[ALEInterface] = []
        for _ in range(number):
            emulator = ALEInterface()
            emulator.setInt("frame_skip", frame_skip)
            emulator.setFloat("repeat_action_probability", sticky)
            emulator.setInt("random_seed", 0)
            emulator.loadROM(rom)
            self._emulators.append(emulator)
        height, width = self._emulators[0].getScreenDims()
        self.ram: Bytes = np.zeros((number, self._emulators[0].getRAMSize()), np.uint8)
        self.screens: Bytes = np.zeros((number, height, width, 3), np.uint8)
        self._shares = [range(first, number, threads) for first in range(min(threads, number))]
        self._pool = ThreadPoolExecutor(len(self._shares)) if len(self._shares) > 1 else None
        self.start = self._first_moment()

    def __len__(self) -> int:
        return len(self._emulators)

    def seed(self, seed: int) -> None:
        """Seeds the sticky actions, which each emulator draws from a generator of its own; games start again then."""
        if not self._sticky:
            return  # nothing else is drawn, and loading takes a tenth of a second each
        own = np.random.SeedSequence(seed).generate_state(len(self)) >> 1  # 31 bits
        for emulator, its_seed in zip(self._emulators, own.tolist(), strict=True):
            emulator.setInt("random_seed", its_seed)
            emulator.loadROM(self._rom)

    def _first_moment(self) -> Snapshot:
        self._emulators[0].reset_game()
        self._look(0)
        return self.save(0)

    def act(self, actions: Sequence[int]) -> NDArray[np.float32]:
        """One action in each emulator; returns the increases of the scores, ``[N]``."""
        rewards = np.zeros(len(self), np.float32)

        def play(share: range) -> None:
            for index in share:
                rewards[index] = self._emulators[index].act(actions[index])
                self._look(index)

        self._each(play)
        return rewards

    def _each(self, work: Callable[[range], None]) -> None:
        if self._pool is None:
            work(self._shares[0])
        else:
            list(self._pool.map(work, self._shares))  # the list raises what a thread raised

    def act_alone(self, index: int, action: int, times: int = 1) -> float:
        """Repeats an action in one emulator; returns the increase of its score."""
        reward = 0.0
        for _ in range(times):
            reward += self._emulators[index].act(action)
        self._look(index)
        return reward

    def _look(self, index: int) -> None:
        self._emulators[index].getRAM(self.ram[index])
        self._emulators[index].getScreenRGB(self.screens[index])

    def is_over(self, index: int) -> bool:
        """Whether the game has ended."""
        return self._emulators[index].game_over(with_truncation=False)

    def save(self, index: int, *, with_random: bool = False) -> Snapshot:
        """An emulator at this moment, for :meth:`restore`.

        Args:
            index: which one.
            with_random: its generator of sticky actions, too; else it draws on as if nothing had happened.
        """
        state = self._emulators[index].cloneState(include_rng=with_random).serialize()
        return Snapshot(state, self.ram[index].copy(), self.screens[index].copy())

    def restore(self, index: int, moment: Snapshot) -> None:
        """Puts an emulator back to a moment, its own or that of another one."""
        from ale_py import ALEState

        self._emulators[index].restoreState(ALEState(moment.state))
        self.ram[index], self.screens[index] = moment.ram, moment.screen
