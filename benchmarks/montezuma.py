"""Montezuma's Revenge against a bare loop over ale-py: ``python benchmarks/montezuma.py [--num-envs 16 --threads 2]``.

The loop does what the environment does for an agent: one action of four frames, RAM, screen, 70x70 window, 44x44
image, and a fresh start after each death. It leaves out subgoals, rewards, specs and TensorDict. Both play the same
random actions and must see the same before anything is timed. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json

import numpy as np
import torch
from ale_py import ALEInterface, LoggerMode, roms
from timing import compare
from torch import Tensor
from torch.nn.functional import interpolate

from hdrqn_torchrl.envs import make_montezuma

X, Y, DYING = 42, 43, 55


class RawLoop:
    """Emulators stepped one after the other."""

    def __init__(self, number: int) -> None:
        ALEInterface.setLoggerMode(LoggerMode.Error)
        self.emulators = []
        for _ in range(number):
            emulator = ALEInterface()
            emulator.setInt("frame_skip", 4)
            emulator.setFloat("repeat_action_probability", 0.0)
            emulator.loadROM(roms.get_rom_path("montezuma_revenge"))
            emulator.reset_game()
            self.emulators.append(emulator)
        self.start = self.emulators[0].cloneState()
        self.ram, self.screen = np.zeros(128, np.uint8), np.zeros((210, 160, 3), np.uint8)

    def step(self, actions: list[int]) -> Tensor:
        """One action in each; returns what the agents see ``[N, 3, 44, 44]``."""
        windows = np.zeros((len(actions), 70, 70, 3), np.uint8)
        for emulator, action, window in zip(self.emulators, actions, windows, strict=True):
            emulator.act(action)
            emulator.getRAM(self.ram)
            emulator.getScreenRGB(self.screen)
            left, top = round(self.ram[X] + 2.5 - 35), round(317.5 - self.ram[Y] - 35)
            x0, y0, x1, y1 = max(left, 0), max(top, 0), min(left + 70, 160), min(top + 70, 210)
            window[y0 - top : y1 - top, x0 - left : x1 - left] = self.screen[y0:y1, x0:x1]
            if self.ram[DYING]:
                emulator.restoreState(self.start)
        images = torch.from_numpy(windows).permute(0, 3, 1, 2)
        return interpolate(images, (44, 44), mode="bilinear", antialias=True).contiguous()


class OurLoop:
    """The environment, stepped as a collector does it."""

    def __init__(self, number: int, threads: int) -> None:
        self.env = make_montezuma(number, max_steps=10**6, threads=threads, seed=0)
        self.tensordict = self.env.reset()

    def step(self, actions: list[int]) -> Tensor:
        """One action in each; returns what the agents see ``[N, 3, 44, 44]``."""
        stepped, self.tensordict = self.env.step_and_maybe_reset(self.tensordict.set("action", torch.tensor(actions)))
        return stepped["next", "observation"]


def main() -> None:
    """Checks, times, prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--blocks", type=int, default=12, help="pairs of blocks")
    parser.add_argument("--seconds", type=float, default=0.8, help="length of a block")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    raw, ours = RawLoop(arguments.num_envs), OurLoop(arguments.num_envs, arguments.threads)
    generator = np.random.default_rng(0)

    def draw() -> list[int]:
        return generator.integers(18, size=arguments.num_envs).tolist()

    for _ in range(100):
        actions = draw()
        assert (raw.step(actions) == ours.step(actions)).all()
    times = compare(
        lambda: ours.step(draw()), lambda: raw.step(draw()), blocks=arguments.blocks, seconds=arguments.seconds
    )
    rates = {name: round(1e3 * arguments.num_envs / times[f"{name}_ms"]) for name in ("ours", "raw")}
    share = {"share_of_raw": round(1 / times["ratio"], 3)}
    print(json.dumps({"num_envs": arguments.num_envs, "steps_per_second": rates, **times, **share}, indent=2))


if __name__ == "__main__":
    main()
