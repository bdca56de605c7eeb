"""Trains one agent: ``python train.py env=gridworld algo=v2``. Any setting of conf/ can be overridden; -m sweeps."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from hdrqn_torchrl.cli import launchers, sweeps
from hdrqn_torchrl.cli.command_line import overrides_last, results_alone
from hdrqn_torchrl.cli.configuration import CONF, RunError, resolved
from hdrqn_torchrl.cli.failures import note_error
from hdrqn_torchrl.cli.misspelt import misspelt_named
from hdrqn_torchrl.cli.resuming import Plan, command, plan, with_groups_of_run
from hdrqn_torchrl.cli.together import plans, train_together
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.run_settings import RunSettings, check


def main() -> None:
    """Runs with the arguments of the command line."""
    sys.argv[1:] = with_groups_of_run(overrides_last(sys.argv[1:]))
    launchers.register()
    try:
        launchers.refuse_missing(sys.argv)
    except SettingsError as error:
        sys.exit(f"error: {error}")
    with misspelt_named(sys.argv[1:]):
        composed()


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def composed(config: DictConfig) -> float:
    """Builds and trains; returns the final greedy return, so that a sweeper can maximise it.

    Exit codes: 0 done; 1 failed, and a message says why; 130 and 143 stopped by SIGINT or SIGTERM: resume me.
    """
    folder, run = Path(HydraConfig.get().runtime.output_dir), None
    os.chdir(HydraConfig.get().runtime.cwd)  # where paths were given: hydra.job.chdir=true would move below them
    sweeps.refuse_if_stopped()
    try:
        settings = resolved(config)
        check(settings)
        if settings.seeds is not None:
            runs = plans(config, folder)
            load(settings.threads)
            from hdrqn_torchrl.cli.training import pieces

            with results_alone():
                return train_together(runs, pieces)
        run = plan(settings, folder)
        if run.folder != folder:
            sweeps.note_folder(run.folder)
        with results_alone():
            return train(run)
    except KeyboardInterrupt as stop:
        told = str(stop) or "stopped"
        if config.seeds is None:
            told += f"; `{goes_on(folder, config) if run is None else goes_on(run.folder, run.config)}` goes on"
        print(told, file=sys.stderr)
        sweeps.end_stopped_job(getattr(stop, "exit_code", 130))
    except Exception as error:
        if run is None and not layout.holds_run(folder):
            note_error(folder)
        if sweeps.is_sweep() or not isinstance(error, (SettingsError, RunError)):
            raise
        sys.exit(f"error: {error}")


def goes_on(folder: Path, config: DictConfig | RunSettings) -> str:
    """The command that resumes a run, with all that it must allow: what the user's own command named."""
    settings = resolved(config) if isinstance(config, DictConfig) else config
    return command(folder, settings.allowed_targets)


def train(run: Plan) -> float:
    """One training run, from its beginning or from a checkpoint; returns its final greedy return."""
    load(run.config.threads)
    from hdrqn_torchrl.cli.training import pieces
    from hdrqn_torchrl.runs.interruption import StopRequest
    from hdrqn_torchrl.runs.together import finish

    return finish(pieces(run, StopRequest()))


def load(threads: int) -> None:
    """Loads torch and torchrl, which take seconds; --help and --cfg do without them."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    import torch
    import torchrl  # noqa: F401

    torch.set_num_threads(threads)
