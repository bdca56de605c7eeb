"""Several seeds in one process: ``python train.py seeds=0..9``."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Generator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from hdrqn_torchrl.cli import sweeps
from hdrqn_torchrl.cli.configuration import RunError, resolved
from hdrqn_torchrl.cli.resuming import Plan, command, plan
from hdrqn_torchrl.runs.settings.run_settings import check, pick_device
from hdrqn_torchrl.runs.settings.seeds import read_seeds

if TYPE_CHECKING:
    from hdrqn_torchrl.runs.interruption import StopRequest


def plans(config: DictConfig, folder: Path) -> list[Plan]:
    """The trainings of a command with ``seeds``: each has the settings and files of one with ``seed`` instead.

    Args:
        config: what the command line composes to.
        folder: Hydra's new run folder; each training has its own beside or below it (:func:`folder_of`).

    Raises:
        SettingsError: as :func:`~hdrqn_torchrl.cli.resuming.plan`.
    """
    seeds = read_seeds(resolved(config).seeds)
    found = []
    for seed in seeds:
        settings = resolved(_with_seed(config, seed))
        check(settings)
        own = plan(settings, folder_of(folder, config.seed, seed))
        found.append(replace(own, label=own.folder.name if sweeps.is_sweep() else f"seed {seed}"))
    with contextlib.suppress(OSError):  # Hydra made it; no training need have it
        folder.rmdir()
    return found


def _with_seed(config: DictConfig, seed: int) -> DictConfig:
    """Before references are resolved, as other settings may refer to the seed."""
    own = config.copy()
    own.seed, own.seeds = seed, None
    return own


def folder_of(folder: Path, named: int, seed: int) -> Path:
    """The folder of one seed's training.

    Examples:
        >>> folder_of(Path("outputs/gridworld-v2/today-seed0"), 0, 7).name
        'today-seed7'
        >>> folder_of(Path("outputs/mine"), 0, 7).as_posix()
        'outputs/mine/seed7'
    """
    ending = f"seed{named}"
    if folder.name.endswith(ending):
        return folder.with_name(folder.name.removesuffix(ending) + f"seed{seed}")
    return folder / f"seed{seed}"


def train_together(runs: list[Plan], pieces: Callable[[Plan, StopRequest], Generator[None, None, float]]) -> float:
    """Trains all of them, by turns; returns the mean of their final greedy returns.

    Args:
        runs: trainings.
        pieces: one of them, in pieces.

    Raises:
        RunError: if some failed, once the others are done.
        Interrupted: on SIGINT or SIGTERM, after all were saved.
    """
    import torch

    from hdrqn_torchrl.runs.interruption import Interrupted, StopRequest
    from hdrqn_torchrl.runs.together import take_turns

    kind = pick_device(runs[0].config.device, torch.cuda.is_available())
    with StopRequest() as stop:
        results, ended = take_turns({run.label: pieces(run, stop) for run in runs}, kind=kind)
    failed = {name: error for name, error in ended.items() if not isinstance(error, Interrupted)}
    for run in runs:
        if isinstance(ended.get(run.label), Interrupted):
            print(f"{run.label}: `{command(run.folder, run.config.allowed_targets)}` goes on", file=sys.stderr)
        elif run.label in failed:
            print(f"{run.label}: {failed[run.label]}", file=sys.stderr)
    if stopped := next((error for error in ended.values() if isinstance(error, Interrupted)), None):
        raise stopped
    if failed:
        raise RunError(f"{len(failed)} of {len(runs)} trainings failed: {', '.join(failed)}")
    return sum(results.values()) / len(results)
