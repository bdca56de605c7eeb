"""Our own agents by ``train.py``: ``python benchmarks/peers/ours.py id=MiniGrid-DoorKey-8x8-v0 bonus=1``.

Without ``levels=2`` it is the flat one: v3's memory, loss and predictions without subgoals to choose. The same command
goes on where it was stopped, from the last checkpoint. All settings but those below are those of ``conf/``.
"""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from arguments import Arguments
from evaluations import Evaluation, write
from tasks import LONG_EXPLORATION, exploration_of, settings_of_task

ROOT = Path(__file__).parents[2]
PAUSE = 1.0
"""Seconds between two looks at the time that a run has used."""
_STOPS = (signal.SIGTERM, signal.SIGINT)
_WELL = (0, *(128 + stop for stop in _STOPS), *(-stop for stop in _STOPS))  # exit codes: done, stopped


@dataclass(frozen=True, kw_only=True)
class OurArguments(Arguments):
    """Those of all peers, and one more.

    Args:
        levels: 1: the flat agent; 2: the hierarchical one, which takes no bonus.
    """

    levels: int = 1

    @property
    def agent(self) -> str:
        """Its name in the table."""
        return "v3_flat" if self.levels == 1 else f"v3_{self.levels}_levels"

    @property
    def folder(self) -> Path:
        """Of the run."""
        return self.runs / self.name_of(self.agent)


def settings_of(arguments: OurArguments) -> list[str]:
    """What ``train.py`` is told; it goes on with a run that lies in the folder already."""
    return [
        *settings_of_task(arguments.id, max_steps=arguments.max_steps),
        "algo=v3",
        f"algo.levels={arguments.levels}",
        f"algo.bonus_reward={arguments.bonus}",
        *(longer_exploration(arguments.id) if arguments.id in LONG_EXPLORATION else ()),
        f"seed={arguments.seed}",
        f"total_frames={arguments.frames}",
        "device=cpu",
        f"evaluation.num_envs={min(100, arguments.episodes)}",
        f"evaluation.episodes={arguments.episodes}",
        f"evaluation.final_episodes={arguments.final_episodes}",
        f"evaluation.interval_frames={arguments.interval_frames}",
        "evaluation.ceilings=false",
        "logger=csv",
        "resume=auto",
        f"hydra.run.dir={arguments.folder}",
    ]


def longer_exploration(id: str) -> list[str]:
    """The meta level explores twice as long as the sub level, as in ``conf/``."""
    frames = exploration_of(id).frames
    return [f"algo.sub_exploration.anneal_frames={frames}", f"algo.meta_exploration.anneal_frames={2 * frames}"]


def train(arguments: OurArguments) -> None:
    """Trains until frames or time are used up."""
    if spent(arguments.folder) >= arguments.seconds:
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # or train.py would be left to itself, without a limit
    words = [sys.executable, str(ROOT / "train.py"), *settings_of(arguments)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(words, env=environment) as process:
        try:
            while process.poll() is None and spent(arguments.folder) < arguments.seconds:
                time.sleep(PAUSE)
        except KeyboardInterrupt:
            pass
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)  # it saves first
            process.wait()
    if process.returncode not in _WELL:
        sys.exit(f"error: train.py ended with exit code {process.returncode}; see above.")


def spent(folder: Path) -> float:
    """Processor time up to the last log point."""
    return max((float(row.get("processor_seconds") or 0.0) for row in rows_of(folder)), default=0.0)


def rows_of(folder: Path) -> list[dict[str, str]]:
    """Log points so far."""
    path = folder / "metrics.csv"
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def evaluations_of(arguments: OurArguments) -> list[Evaluation]:
    """What a run folder tells, in the words of all peers."""
    found = [_evaluation(arguments, _figures(row)) for row in rows_of(arguments.folder) if row.get("greedy/return")]
    summary = arguments.folder / "summary.json"
    if summary.exists():
        last = _evaluation(arguments, json.loads(summary.read_text()), final=True)
        return [each for each in found if each.frames < last.frames] + [last]
    if found and spent(arguments.folder) >= arguments.seconds:
        found[-1] = replace(found[-1], final=True)
    return found


def _figures(row: dict[str, str]) -> dict[str, Any]:
    """Of a greedy evaluation while training."""
    return {
        "frames": row["frames"],
        "wall_seconds": row["wall_seconds"],
        "processor_seconds": row["processor_seconds"],
        "episodes": row["greedy/episodes"],
        "return_mean": row["greedy/return"],
        "success_rate": row["greedy/success"],
        "steps_mean": row["greedy/steps"],
    }


def _evaluation(arguments: OurArguments, figures: dict[str, Any], *, final: bool = False) -> Evaluation:
    return Evaluation(
        agent=arguments.agent,
        id=arguments.task,
        bonus=arguments.bonus,
        seed=arguments.seed,
        frames=int(float(figures["frames"])),
        seconds=float(figures["wall_seconds"]),
        cpu_seconds=float(figures["processor_seconds"]),
        episodes=int(float(figures["episodes"])),
        return_mean=float(figures["return_mean"]),
        success_rate=float(figures["success_rate"]),
        steps_mean=float(figures["steps_mean"]),
        final=final,
    )


def main() -> None:
    """One run."""
    arguments = OurArguments.read(sys.argv[1:])
    path = arguments.results / f"{arguments.name_of(arguments.agent)}.jsonl"
    train(arguments)
    write(path, evaluations_of(arguments))


if __name__ == "__main__":
    main()
