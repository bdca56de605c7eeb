"""Trains one agent: ``python train.py env=gridworld algo=v2``. Any setting of conf/ can be overridden; -m sweeps."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.types import RunMode
from omegaconf import MISSING, DictConfig, OmegaConf

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from hdrqn_torchrl.trainer import Trainer


@dataclass
class EvaluationSchema:
    """Greedy evaluation."""

    num_envs: int = MISSING
    episodes: int = MISSING
    interval_frames: int = MISSING
    final_episodes: int = MISSING
    seed: int = MISSING


@dataclass
class Schema:
    """Top-level settings and their types; a key that is not here is refused."""

    env: Any = MISSING
    algo: Any = MISSING
    network: Any = MISSING
    logger: Any = MISSING
    seed: int = MISSING
    device: str = MISSING
    threads: int = MISSING
    total_frames: int = MISSING
    steps_per_batch: int = MISSING
    log_frames: int = MISSING
    evaluation: EvaluationSchema = field(default_factory=EvaluationSchema)


ConfigStore.instance().store(name="schema", node=Schema)


class SettingsError(ValueError):
    """A setting that breaks its rule, found before training."""


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def main(config: DictConfig) -> float:
    """Builds and trains; returns the final greedy return, so that a sweeper can maximise it."""
    try:
        return train(config)
    except KeyboardInterrupt:
        sys.exit("interrupted: weights, metrics and summary up to here are in the run folder")
    except SettingsError as error:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            raise
        sys.exit(f"error: {error}")


def train(config: DictConfig) -> float:
    """One training run in Hydra's run folder."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    # torch and torchrl take seconds to load; --help and --cfg do without them.
    import torch

    folder = Path(HydraConfig.get().runtime.output_dir)
    torch.set_num_threads(config.threads)
    try:
        check(config)
        trainer, evaluation_env, references = build(config, folder)
    except (InstantiationException, ValueError) as error:
        raise SettingsError(explain(error)) from error
    OmegaConf.save(config, folder / "config.yaml", resolve=True)
    try:
        trainer.train()
    except KeyboardInterrupt:
        write_summary(config, folder, trainer, evaluation_env, references)
        raise
    return write_summary(config, folder, trainer, evaluation_env, references)["return_mean"]


def write_summary(
    config: DictConfig, folder: Path, trainer: Trainer, evaluation_env: EnvBase, references: dict
) -> dict[str, float]:
    """Final greedy evaluation; writes and prints the run's results."""
    from hdrqn_torchrl.evaluation import evaluate
    from hdrqn_torchrl.run_folder import write_results

    result = evaluate(
        evaluation_env,
        trainer.algorithm.policy,
        episodes=config.evaluation.final_episodes,
        seed=config.evaluation.seed + 1,
    )
    choices = HydraConfig.get().runtime.choices
    title = " ".join([*(f"{name}={choices[name]}" for name in ("env", "algo", "network")), f"seed={config.seed}"])
    summary = write_results(folder, trainer, result, references=references, title=title)
    print(json.dumps({"run": str(folder), **summary}))
    return summary


def build(config: DictConfig, folder: Path) -> tuple[Trainer, EnvBase, dict]:
    """Everything that a run needs, from its configuration: trainer, evaluation environment, scripted references."""
    import torch
    from hydra.utils import instantiate
    from torchrl.collectors import Collector

    from hdrqn_torchrl.evaluation import evaluate
    from hdrqn_torchrl.logging import RunLogger
    from hdrqn_torchrl.run_folder import ceiling_of, references_for
    from hdrqn_torchrl.trainer import Trainer

    device = pick_device(config.device, torch.cuda.is_available())
    torch.manual_seed(config.seed)
    env = instantiate(config.env, seed=config.seed, device=device)
    algorithm = instantiate(config.algo, env, instantiate(config.network))
    evaluation_env = algorithm.transform(instantiate(config.env, num_envs=config.evaluation.num_envs, device=device))
    references = references_for(env)
    frames_per_batch = env.batch_size[0] * config.steps_per_batch
    collector = Collector(
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
            folder,
            total_frames=config.total_frames,
            loggers=[instantiate(logger, folder) for logger in config.logger.loggers],
        ),
        evaluate=lambda: evaluate(
            evaluation_env, algorithm.policy, episodes=config.evaluation.episodes, seed=config.evaluation.seed
        ),
        total_frames=config.total_frames,
        log_frames=config.log_frames,
        evaluation_frames=config.evaluation.interval_frames,
        checkpoints=folder / "checkpoints",
        ceiling=ceiling_of(references),
    )
    return trainer, evaluation_env, references


def check(config: DictConfig) -> None:
    """Refuses keys that nothing reads and numbers that would fail only in the middle of a run."""
    for section, schema in ((config, Schema), (config.evaluation, EvaluationSchema)):
        if unknown := set(section) - {known.name for known in fields(schema)}:  # added with +
            raise ValueError(f"{min(unknown)} must be a known setting; `python train.py --cfg job` shows all of them.")
    for key, least in (
        ("total_frames", 1),
        ("threads", 1),
        ("steps_per_batch", 2),  # TorchRL's two-dimensional storage can't take single steps
        ("log_frames", 1),
        ("evaluation.num_envs", 1),
        ("evaluation.episodes", 1),
        ("evaluation.interval_frames", 1),
        ("evaluation.final_episodes", 1),
    ):
        value = OmegaConf.select(config, key)
        if value < least:
            raise ValueError(f"{key} must be >= {least}, got {value}; leave it out for the default.")
    if config.device not in ("auto", "cpu", "cuda"):
        raise ValueError(f"device must be auto, cpu or cuda, got {config.device!r}; auto takes a GPU if there is one.")


def pick_device(name: str, has_cuda: bool) -> str:
    """``auto`` is the GPU where there is one."""
    if name == "cuda" and not has_cuda:
        raise ValueError("device must be cpu or auto on a machine without a usable GPU, got 'cuda'; use device=auto.")
    return ("cuda" if has_cuda else "cpu") if name == "auto" else name


def explain(error: Exception) -> str:
    """The cause of a failed instantiation, with the full name of the setting in front."""
    if not isinstance(error, InstantiationException):
        return str(error)
    path = str(error).rpartition("full_key: ")[2].strip() if "full_key: " in str(error) else ""
    cause = error.__cause__
    if isinstance(cause, ValueError):
        return f"{path}.{cause}" if path else str(cause)
    return f"{path}: {cause or error}; `python train.py --cfg job` shows every setting and its default."


if __name__ == "__main__":
    main()
