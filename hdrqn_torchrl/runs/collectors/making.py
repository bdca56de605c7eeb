"""The collector that a run's settings ask for."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from hdrqn_torchrl.algorithms import Algorithm
from hdrqn_torchrl.learning.captured import wants_capture
from hdrqn_torchrl.runs.collectors.captured import CapturedCollector, can_capture
from hdrqn_torchrl.runs.collectors.resumable import ResumableCollector
from hdrqn_torchrl.runs.collectors.workers import ProcessWorkers, Worker, WorkersCollector
from hdrqn_torchrl.runs.collectors.workers.collector import check_workers
from hdrqn_torchrl.runs.collectors.workers.handles import WorkerPlace
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.building import build_algorithm
from hdrqn_torchrl.runs.settings.run_settings import RunSettings


def make_collector(
    settings: RunSettings,
    env: EnvBase,
    algorithm: Algorithm,
    *,
    device: str,
    allowed: Sequence[str] = (),
) -> ResumableCollector | CapturedCollector | WorkersCollector:
    """This process as the only collector, or workers.

    Args:
        settings: all of a run.
        env: bare environment of all worlds.
        algorithm: made for it.
        device: of this process; workers act on CPUs.
        allowed: see :func:`~hdrqn_torchrl.runs.settings.building.build`.

    Raises:
        ValueError: if the worlds can't be divided among the workers, or the agent finds its subgoals itself and there
            are workers.
        SettingsError: if there is no Ray, or no cluster of it.
    """
    chosen, worlds = settings.collector, env.batch_size[0]
    frames_per_batch = worlds * settings.steps_per_batch
    total_frames = -(-settings.total_frames // frames_per_batch) * frames_per_batch
    transformed = algorithm.transform(env)
    if chosen.kind == "local" and wants_capture(settings.capture, device) and can_capture(transformed):
        return CapturedCollector(
            transformed, algorithm.policy, frames_per_batch=frames_per_batch, total_frames=total_frames
        )
    if chosen.kind == "local":
        return ResumableCollector(
            transformed,
            algorithm.policy,
            frames_per_batch=frames_per_batch,
            total_frames=total_frames,
            device=device,
            auto_register_policy_transforms=False,
        )
    check_workers(chosen.workers, worlds)
    if "discovery" in algorithm.monitors:
        raise ValueError(
            f"collector must be local with algo.subgoals=discovered, got {chosen.kind}: workers would not learn what "
            "is found; leave collector out."
        )
    make = partial(
        Worker,
        partial(worker_part, settings, tuple(allowed), worlds // chosen.workers),
        steps=settings.steps_per_batch,
        all_worlds=worlds,
        threads=settings.threads,
    )
    return WorkersCollector(
        _place(settings, make),
        transformed,
        algorithm.policy,
        workers=chosen.workers,
        total_frames=total_frames,
        sync=chosen.sync,
        seed=settings.seed,
        updates=lambda: algorithm.updates,
        patience_seconds=chosen.patience_seconds,
    )


def worker_part(
    settings: RunSettings, allowed: Sequence[str], worlds: int, index: int, seed: int
) -> tuple[EnvBase, TensorDictModuleBase]:
    """A worker's environment and policy, built where it runs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the learner has built the same, and warned
        changes = {"seed": seed, "num_envs": worlds, "device": "cpu"}
        env, algorithm = build_algorithm(settings, changes, allowed)
    return algorithm.transform(env), algorithm.policy.cpu()


def _place(settings: RunSettings, make: partial[Worker]) -> WorkerPlace:
    if settings.collector.kind == "processes":
        return ProcessWorkers(make)
    from hdrqn_torchrl.runs.collectors.workers.ray_workers import RayWorkers

    try:
        return RayWorkers(make, workers=settings.collector.workers, address=settings.collector.address)
    except (ImportError, OSError) as error:  # of the machine, not of a setting
        raise SettingsError(str(error)) from error
