"""Loggers of services: TensorBoard, Weights & Biases, MLflow; a run that is resumed goes on in the same place."""

from __future__ import annotations

import importlib
import json
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from torchrl.record.loggers.common import Logger
from torchrl.record.loggers.tensorboard import TensorboardLogger

from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.files import check_folder, read_json, write_whole
from hdrqn_torchrl.runs.persistence.locking import lock
from hdrqn_torchrl.runs.settings.comparing import flat


class RewindingTensorboardLogger(TensorboardLogger):
    """TorchRL's TensorBoard logger, which can go back: a killed run does some of its frames again."""

    def go_back_to(self, frames: int) -> None:
        """TensorBoard will not show points later than ``frames``, as they are going to be logged again."""
        self.experiment.close()
        self.experiment.purge_step = frames + 1  # read when the next file of events is begun

    def flush(self) -> None:
        """Writes what is buffered."""
        self.experiment.flush()


def make_tensorboard_logger(folder: Path) -> Logger:
    """TorchRL's TensorBoard logger, writing to ``folder/tensorboard``."""
    check_folder(folder / layout.TENSORBOARD, root=folder)
    return RewindingTensorboardLogger(layout.TENSORBOARD, log_dir=str(folder))


def make_wandb_logger(
    folder: Path, *, project: str = "hdrqn_torchrl", offline: bool = False, settings: dict[str, Any] | None = None
) -> Logger:
    """TorchRL's Weights & Biases logger, writing to ``folder/wandb``.

    ``folder/wandb.json`` keeps the id of the W&B run: a resumed run goes on with it. W&B takes no step back: it warns
    of frames that are done again and leaves them out.

    Args:
        folder: run folder; its last two parts are the name of the W&B run.
        project: W&B project.
        offline: keeps everything in ``folder/wandb``; ``wandb sync`` uploads it later.
        settings: shown beside the curves.

    Raises:
        ImportError: if wandb is not installed.
    """
    _require("wandb")
    check_folder(folder / "wandb", root=folder)
    from torchrl.record.loggers.wandb import WandbLogger

    run_id = _recorded(folder / "wandb.json") or secrets.token_hex(4)
    _record(folder / "wandb.json", run_id)
    logger = WandbLogger(
        _name(folder),
        save_dir=str(folder),
        id=run_id,
        project=project,
        mode="offline" if offline else None,  # the logger's own offline= would stay set for later runs in this process
        reinit="finish_previous",  # of a sweep
        log_env_packages=False,  # paths of this machine
    )
    logger.log_hparams(settings or {})
    return logger


def make_mlflow_logger(
    folder: Path,
    *,
    tracking_uri: str,
    experiment: str = "hdrqn_torchrl",
    settings: dict[str, Any] | None = None,
) -> Logger:
    """TorchRL's MLflow logger.

    ``folder/mlflow.json`` keeps the id of the MLflow run: a resumed run goes on with it. MLflow takes nothing back:
    frames that are done again are not logged a second time (``logged_until``).

    Args:
        folder: run folder; its last two parts are the name of the MLflow run.
        tracking_uri: address of a server, or ``sqlite:///`` and the path of a file, which is created.
        experiment: MLflow experiment; created if it does not exist.
        settings: logged as parameters when the run begins.

    Raises:
        ImportError: if mlflow is not installed.
        ValueError: if the recorded run is not in that database.
    """
    mlflow = _require("mlflow")
    from torchrl.record.loggers.mlflow import MLFlowLogger

    mlflow.end_run()  # of an earlier job of a sweep in this process
    mlflow.set_tracking_uri(tracking_uri)
    with _one_at_a_time(tracking_uri):
        mlflow.set_experiment(experiment)
    record = folder / "mlflow.json"
    if run_id := _recorded(record):
        os.environ["MLFLOW_RUN_ID"] = run_id  # read once, when the logger starts its run
    try:
        logger = MLFlowLogger(experiment, tracking_uri)
    except mlflow.exceptions.MlflowException as error:
        raise ValueError(
            f"tracking_uri must be where the run was logged before, and {tracking_uri} does not know it ({error}); "
            f"remove {record} to log the rest as a new run."
        ) from error
    finally:
        os.environ.pop("MLFLOW_RUN_ID", None)
    if run_id is None:
        _record(record, logger.experiment.info.run_id)
        mlflow.set_tag("mlflow.runName", _name(folder))
        logger.log_hparams(flat(settings) if settings else {})
    else:
        logger.logged_until = logger.experiment.data.metrics.get("frames", -1)
    return logger


@contextmanager
def _one_at_a_time(tracking_uri: str) -> Iterator[None]:
    """MLflow fails if two processes create the same SQLite file at once, as the first jobs of a parallel sweep do."""
    if not tracking_uri.startswith("sqlite:///"):
        yield
        return
    path = Path(tracking_uri.removeprefix("sqlite:///"))
    path.parent.mkdir(parents=True, exist_ok=True)
    with lock(path.with_name(f"{path.name}.lock"), patience_seconds=600.0):
        yield


def _require(package: str) -> ModuleType:
    """Imports an optional package."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ImportError(
            f"logger={package} needs the package {package} ({error}): pip install 'hdrqn_torchrl[{package}]'"
        ) from error


def _name(folder: Path) -> str:
    return "/".join(folder.absolute().parts[-2:])


def _recorded(path: Path) -> str | None:
    """Id of the run at the service, if this is a resumed run."""
    if not path.exists():
        return None
    found = read_json(path)
    run_id = found.get("id") if isinstance(found, dict) else None
    if not isinstance(run_id, str) or not re.fullmatch(r"[\w-]{1,64}", run_id):
        raise ValueError(f"{path} must name the run to continue; remove it to log the rest as a new one.")
    return run_id


def _record(path: Path, run_id: str) -> None:
    write_whole(path, json.dumps({"id": run_id}) + "\n")
