"""Launchers of sweeps (``sweep=ray``, ``sweep=slurm``): each job runs elsewhere as it would run here.

A job that was begun before, since it was preempted, requeued, or lost with its machine, goes on where it was saved.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, run_job, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from hdrqn_torchrl.cli import sweeps
from hdrqn_torchrl.cli.ledger import was_started
from hdrqn_torchrl.cli.together import folder_of
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.seeds import read_seeds
from hdrqn_torchrl.runs.settings.variables import search_path, variables

PLUGINS, PACKAGE = "hydra_plugins", "hydra_plugins.hdrqn_torchrl"  # Hydra takes launchers from nowhere else
_PLUGINS_OF_SWEEPS = {"parallel": ("hydra_joblib_launcher", "sweep"), "search": ("hydra_optuna_sweeper", "search")}
_LOOK_SECONDS = 0.5


class Job:
    """One job of a sweep, to be pickled; call it in a process of its own.

    Args:
        launcher: which makes it.
        number: of the job.
        overrides: its part of the command line.
    """

    def __init__(self, launcher: ElsewhereLauncher, number: int, overrides: Sequence[str]) -> None:
        self.context, self.task, self.config = launcher.context, launcher.task, launcher.config
        self.number, self.overrides = number, list(overrides)
        self.singletons = {kind: each for kind, each in Singleton.get_state().items() if kind is not Plugins}

    def __call__(self) -> JobReturn:
        """Runs it to its end, or until it is stopped."""
        Singleton.set_state(self.singletons)
        setup_globals()
        sweeps.begin_elsewhere()
        os.chdir(self.config.hydra.runtime.cwd)
        config = self._composed(self.overrides)
        if was_started(config.hydra, self.number) and any((each / layout.CONFIG).exists() for each in _folders(config)):
            config = self._composed([*self.overrides, "resume=auto"])
        return run_job(
            hydra_context=self.context, task_function=self.task, config=config,
            job_dir_key="hydra.sweep.dir", job_subdir_key="hydra.sweep.subdir",
        )  # fmt: skip

    def lost(self, error: Exception) -> JobReturn:
        """Its result, in the sweep's main process, if it left none."""
        return sweeps.note_lost(self._composed(self.overrides), error)

    def _composed(self, overrides: list[str]) -> DictConfig:
        config = self.context.config_loader.load_sweep_config(self.config, overrides)
        with open_dict(config):
            config.hydra.job.id, config.hydra.job.num = f"{config.hydra.job.name}_{self.number}", self.number
        HydraConfig.instance().set_config(config)  # which the names of folders refer to
        return config


class PreemptedJob(Job):
    """A job of Slurm: told to make room, it saves itself first, and is then queued again by submitit."""

    def __call__(self) -> JobReturn:
        """See :class:`Job`."""
        requeue, asked = signal.getsignal(signal.SIGUSR2), []

        def stop(number: int, frame: FrameType | None) -> None:
            asked.append((number, frame))
            signal.raise_signal(signal.SIGTERM)

        signal.signal(signal.SIGUSR2, stop)
        result = super().__call__()
        if asked and sweeps.was_stopped() and callable(requeue):
            requeue(*asked[0])  # ends this process
        return result

    def checkpoint(self) -> Any:
        """What submitit queues again."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


class ElsewhereLauncher(Launcher):
    """Base of both. Ctrl-C lets the jobs at work save themselves."""

    context: HydraContext
    task: TaskFunction
    config: DictConfig

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.context, self.task, self.config = hydra_context, task_function, config


class RayLauncher(ElsewhereLauncher):
    """Jobs as tasks of a Ray cluster.

    Args:
        address: of a running cluster, or ``auto``; ``None``: one begins and ends with the sweep, on 127.0.0.1.
        cores_per_job: of the cluster's cores; so many jobs run at once as there are cores for.
        gpus_per_job: likewise.
        restarts: of a job whose process or machine was lost.
    """

    __module__ = PACKAGE

    def __init__(self, *, address: str | None, cores_per_job: int, gpus_per_job: float, restarts: int) -> None:
        self.address, self.restarts = address, restarts
        self.cores_per_job, self.gpus_per_job = cores_per_job, gpus_per_job

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        from hdrqn_torchrl.runs.collectors.workers.ray_cluster import RayCluster, load_ray

        os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
        try:
            cluster = RayCluster(
                cores=os.cpu_count() or 1, address=self.address, show_output=True, setting="hydra.launcher.address"
            )
        except (ImportError, OSError) as error:  # of the machine
            sys.exit(f"error: {error}")
        ray = load_ray()
        run = ray.remote(
            num_cpus=self.cores_per_job, num_gpus=self.gpus_per_job, max_retries=self.restarts, max_calls=1
        )(_call)
        try:
            jobs = [Job(self, initial_job_idx + index, each) for index, each in enumerate(job_overrides)]
            tasks = [run.remote(job) for job in jobs]
            waiting, asked = tasks, False
            while waiting:
                _, waiting = ray.wait(waiting, num_returns=len(waiting), timeout=_LOOK_SECONDS)
                cluster.check()
                if sweeps.was_stopped() and not asked:
                    asked = True
                    for task in waiting:
                        ray.cancel(task)  # an interrupt in a task at work
            return [_result(partial(ray.get, task), job) for task, job in zip(tasks, jobs, strict=True)]
        finally:
            cluster.close()


class SlurmLauncher(ElsewhereLauncher):
    """Jobs of Slurm, by submitit. If this process ends, they go on.

    Args:
        cluster: ``slurm``, or ``local``: processes of this machine, all at once, to try it.
        folder: where submitit puts what it submits, and the jobs' output; all machines must see it.
        timeout_min: minutes after which a job is stopped, saves itself, and is queued again.
        requeues: how often that may happen to a job.
        signal_delay_s: seconds that a job has to save itself.
        cpus_per_task: cores of a job.
        mem_gb: memory of a job.
        gpus_per_node: GPUs of a job.
        array_parallelism: jobs at work at once.
        partition: where jobs are queued; ``None``: where Slurm puts them by itself.
        additional_parameters: others of sbatch.
    """

    __module__ = PACKAGE

    def __init__(
        self,
        *,
        cluster: str,
        folder: str,
        timeout_min: int,
        requeues: int,
        signal_delay_s: int,
        cpus_per_task: int,
        mem_gb: float,
        gpus_per_node: int,
        array_parallelism: int,
        partition: str | None,
        additional_parameters: DictConfig,
    ) -> None:
        self.cluster, self.folder, self.requeues = cluster, folder, requeues
        self.parameters = {
            "timeout_min": timeout_min,
            "cpus_per_task": cpus_per_task,
            "mem_gb": mem_gb,
            "gpus_per_node": gpus_per_node,
            "slurm_signal_delay_s": signal_delay_s,
            "slurm_array_parallelism": array_parallelism,
            "slurm_partition": partition,
            "slurm_additional_parameters": OmegaConf.to_container(additional_parameters),
        }

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        jobs = [PreemptedJob(self, initial_job_idx + index, each) for index, each in enumerate(job_overrides)]
        submitted, asked = self._submit(jobs), False
        while waiting := [each for each in submitted if not each.done()]:
            if sweeps.was_stopped() and not asked:
                asked = True
                for each in waiting:
                    self._stop(each)
            time.sleep(_LOOK_SECONDS)
        results = [_result(each.result, job) for each, job in zip(submitted, jobs, strict=True)]
        for path in Path(self.folder).glob("*.pkl"):
            path.unlink()  # only the output stays
        return results

    def _submit(self, jobs: list[PreemptedJob]) -> list[Any]:
        try:
            submitit = _submitit()
        except ImportError as error:
            sys.exit(f"error: {error}")
        options = {} if self.cluster == "local" else {"slurm_max_num_timeout": self.requeues}
        executor = submitit.AutoExecutor(self.folder, cluster=self.cluster, **options)
        given = {name: value for name, value in self.parameters.items() if value is not None}
        executor.update_parameters(name=self.config.hydra.job.name, **given)
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # processes of this machine would end by Ctrl-C, unsaved
        try:
            with variables(search_path()), executor.batch():
                return [executor.submit(job) for job in jobs]
        finally:
            signal.signal(signal.SIGINT, before)

    def _stop(self, submitted: Any) -> None:
        if self.cluster == "local":
            os.kill(int(submitted.job_id), signal.SIGTERM)
        else:
            submitted.cancel(check=False)


def register() -> None:
    """Makes the launchers known to Hydra, as if they lay in its package for plugins."""
    with contextlib.suppress(ModuleNotFoundError):
        import_module(PLUGINS)
    if PLUGINS not in sys.modules:
        sys.modules[PLUGINS] = ModuleType(PLUGINS)
        sys.modules[PLUGINS].__path__ = []  # a package, which Hydra looks through for others
    package = sys.modules[PACKAGE] = ModuleType(PACKAGE)
    for launcher in (RayLauncher, SlurmLauncher):
        setattr(package, launcher.__name__, launcher)
        Plugins.instance().register(launcher)


def refuse_missing(arguments: Sequence[str]) -> None:
    """Ends the program if the command asks for a plugin of Hydra that is not installed, which Hydra calls unknown."""
    for sweep, (plugin, extra) in _PLUGINS_OF_SWEEPS.items():
        if f"sweep={sweep}" in arguments and find_spec(f"{PLUGINS}.{plugin}") is None:
            raise SettingsError(f"sweep={sweep} needs {plugin}; install it: pip install 'hdrqn_torchrl[{extra}]'.")


def _folders(config: DictConfig) -> list[Path]:
    """Of a job's trainings: several with ``seeds``."""
    folder = Path(config.hydra.sweep.dir) / config.hydra.sweep.subdir
    if config.seeds is None:
        return [folder]
    return [folder_of(folder, config.seed, seed) for seed in read_seeds(config.seeds)]


def _call(job: Job) -> JobReturn:
    return job()


def _result(get: Callable[[], JobReturn], job: Job) -> JobReturn:
    try:
        return get()
    except Exception as error:  # whatever it is, the others go on
        return job.lost(error)


def _submitit() -> Any:
    try:
        import submitit
    except ImportError as error:
        raise ImportError("sweep=slurm needs submitit; install it: pip install 'hdrqn_torchrl[slurm]'.") from error
    return submitit
