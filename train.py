"""Trains one agent: ``python train.py env=gridworld algo=v2``. Any setting of conf/ can be overridden; -m sweeps."""

from __future__ import annotations

import contextlib
import json
import os
import random
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.types import RunMode
from omegaconf import DictConfig

from configuration import RunError, SettingsError, build_algorithm, check, explain, pick_device
from resuming import Plan, plan, record

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from hdrqn_torchrl.trainer import Trainer


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def main(config: DictConfig) -> float:
    """Builds and trains; returns the final greedy return, so that a sweeper can maximise it.

    Exit codes: 0 done; 1 failed, and a message says why; 130 and 143 stopped by SIGINT or SIGTERM: resume me.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        check(config)
        run = plan(config, folder)
        folder = run.folder
        return train(run)
    except KeyboardInterrupt as stop:
        code = getattr(stop, "exit_code", 130)
        print(f"{stop or 'stopped'}; `python train.py resume={folder}` goes on", file=sys.stderr)
        sys.exit(code)
    except Exception as error:
        if not (isinstance(error, SettingsError) and (folder / "config.yaml").exists()):  # then it is another's run
            with contextlib.suppress(OSError):
                (folder / "error.txt").write_text(traceback.format_exc())
        if HydraConfig.get().mode == RunMode.MULTIRUN or not isinstance(error, (SettingsError, RunError)):
            raise
        sys.exit(f"error: {error}")


def train(run: Plan) -> float:
    """One training run, from its beginning or from a checkpoint."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    # torch and torchrl take seconds to load; --help and --cfg do without them.
    import torch
    from torchrl.checkpoint import CheckpointError

    from hdrqn_torchrl.learner import NonFiniteError
    from hdrqn_torchrl.run_folder import locked

    torch.set_num_threads(run.config.threads)
    try:
        with locked(run.folder):
            clear_leftovers(run)
            trainer, evaluation_env, references = build(run)
            record(run)
            if run.checkpoint is not None:
                trainer.resume(run.checkpoint)
            trainer.train()
            return write_summary(run, trainer, evaluation_env, references)["return_mean"]
    except (InstantiationException, ValueError) as error:
        raise SettingsError(explain(error)) from error
    except (CheckpointError, NonFiniteError, OSError) as error:
        raise RunError(str(error)) from error


def clear_leftovers(run: Plan) -> None:
    """Removes what a killed process left in the run folder and what a run that starts again will write again."""
    from hdrqn_torchrl.checkpoint import Checkpoints

    Checkpoints(run.folder / "checkpoints").clean_up()
    stale = [*run.folder.glob("*.partial"), run.folder / "error.txt"]
    if run.checkpoint is None:
        stale.append(run.folder / "metrics.csv")
    for path in stale:
        path.unlink(missing_ok=True)


def write_summary(run: Plan, trainer: Trainer, evaluation_env: EnvBase, references: dict) -> dict[str, float]:
    """Final greedy evaluation; writes and prints the run's results."""
    from hdrqn_torchrl.evaluation import evaluate
    from hdrqn_torchrl.run_folder import write_results

    result = evaluate(
        evaluation_env,
        trainer.algorithm.policy,
        episodes=run.config.evaluation.final_episodes,
        seed=run.config.evaluation.seed + 1,
    )
    groups = (f"{name}={run.choices[name]}" for name in ("env", "algo", "network") if name in run.choices)
    title = " ".join([*groups, f"seed={run.config.seed}"])
    summary = write_results(run.folder, trainer, result, references=references, title=title)
    print(json.dumps({"run": str(run.folder), **summary}))
    return summary


def build(run: Plan) -> tuple[Trainer, EnvBase, dict]:
    """Everything that a run needs: trainer, evaluation environment, scripted references."""
    import numpy
    import torch
    from hydra.utils import instantiate

    from hdrqn_torchrl.checkpoint import Checkpoints
    from hdrqn_torchrl.collectors import ResumableCollector
    from hdrqn_torchrl.evaluation import evaluate
    from hdrqn_torchrl.logging import RunLogger
    from hdrqn_torchrl.run_folder import ceiling_of, references_for
    from hdrqn_torchrl.trainer import Trainer

    config = run.config
    device = pick_device(config.device, torch.cuda.is_available())
    random.seed(config.seed)
    numpy.random.seed(config.seed)
    torch.manual_seed(config.seed)
    env, algorithm = build_algorithm(config, seed=config.seed, device=device)
    evaluation_env = algorithm.transform(instantiate(config.env, num_envs=config.evaluation.num_envs, device=device))
    references = references_for(env)
    frames_per_batch = env.batch_size[0] * config.steps_per_batch
    collector = ResumableCollector(
        algorithm.transform(env),
        algorithm.policy,
        frames_per_batch=frames_per_batch,
        total_frames=-(-config.total_frames // frames_per_batch) * frames_per_batch,
        device=device,
        auto_register_policy_transforms=False,
    )
    trainer = Trainer(
        algorithm,
        collector,
        logger=RunLogger(
            run.folder,
            total_frames=config.total_frames,
            loggers=[instantiate(logger, run.folder) for logger in config.logger.loggers],
        ),
        evaluate=lambda: evaluate(
            evaluation_env, algorithm.policy, episodes=config.evaluation.episodes, seed=config.evaluation.seed
        ),
        total_frames=config.total_frames,
        log_frames=config.log_frames,
        evaluation_frames=config.evaluation.interval_frames,
        checkpoints=Checkpoints(run.folder / "checkpoints", keep_last=config.checkpoint.keep_last),
        checkpoint_frames=config.checkpoint.interval_frames,
        checkpoint_seconds=60.0 * config.checkpoint.interval_minutes,
        ceiling=ceiling_of(references),
    )
    return trainer, evaluation_env, references


if __name__ == "__main__":
    main()
