"""Where the numbers of a run go: one CSV row per log point, TensorBoard scalars, a progress line."""

from __future__ import annotations

import csv
import importlib
import json
import math
import os
import secrets
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from torchrl.record.loggers.common import Logger

from hdrqn_torchrl.locking import lock

Row = dict[str, float]


class CSVLog:
    """``metrics.csv``: one row per log point. A column that appears later is added to the header.

    TorchRL's ``CSVLogger`` writes one file per scalar; a run is easier to read as one table.

    Args:
        path: the file; rows are appended to what it holds.

    Examples:
        >>> import tempfile
        >>> log = CSVLog(Path(tempfile.mkdtemp()) / "metrics.csv")
        >>> log.write({"frames": 1, "loss": 0.5})
        >>> log.path.read_text().split()
        ['frames,loss', '1,0.5']
    """

    def __init__(self, path: Path) -> None:
        self.path, self.columns, self.rows = path, list[str](), 0
        if path.exists():
            rows = self._read()
            self.columns, self.rows = list(rows[0]) if rows else [], len(rows)
            if not path.read_bytes().endswith(b"\n"):
                self._rewrite(self.columns, rows)  # the next row would be appended to half of one

    def write(self, row: Row) -> None:
        """Appends one row; it is on the disk when this returns."""
        if new := [name for name in row if name not in self.columns]:
            self._widen(new)
        with self.path.open("a", newline="") as file:
            csv.DictWriter(file, self.columns, restval="", lineterminator="\n").writerow(measured(row))
            file.flush()
            os.fsync(file.fileno())
        self.rows += 1

    def _widen(self, new: list[str]) -> None:
        self._rewrite([*self.columns, *new], self._read() if self.path.exists() else [])

    def _read(self) -> list[dict[str, str]]:
        """All whole rows; a killed process may have left half of one at the end."""
        text = self.path.read_text()
        return list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))

    def _rewrite(self, columns: list[str], rows: list[dict[str, str]]) -> None:
        self.columns, self.rows = columns, len(rows)
        partial = self.path.with_suffix(".partial")
        with partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns, restval="", extrasaction="ignore", lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(self.path)

    def state_dict(self) -> dict[str, Any]:
        """Its position: columns and number of rows."""
        return {"columns": list(self.columns), "rows": self.rows}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a position: later rows are dropped from the file, as they will be written again."""
        if self.path.exists():
            self._rewrite(list(state["columns"]), self._read()[: state["rows"]])


class RunLogger:
    """Sends each log point to the CSV file, to TorchRL loggers and to the terminal.

    Args:
        folder: run folder.
        total_frames: end of the progress bar.
        loggers: any TorchRL loggers (TensorBoard, W&B, ...); scalars are logged under their column's name.
        console: where progress goes; a terminal shows a bar, anything else a line per greedy evaluation.
        label: put before those lines, to tell the runs of a sweep apart.
    """

    def __init__(
        self,
        folder: Path,
        *,
        total_frames: int,
        loggers: list[Logger] | None = None,
        console: Console | None = None,
        label: str = "",
    ) -> None:
        self.label = f"{label}  " if label else ""
        self.csv, self.loggers = CSVLog(folder / "metrics.csv"), loggers or []
        self.console = console or Console(file=sys.stderr)
        self._progress = Progress(
            TextColumn("{task.percentage:>3.0f}%"),
            BarColumn(bar_width=20),
            TaskProgressColumn(text_format="{task.completed:,.0f}/{task.total:,.0f} frames", show_speed=False),
            TimeRemainingColumn(),
            TextColumn("{task.fields[numbers]}"),
            console=self.console,
            disable=not self.console.is_terminal,
        )
        self._task = self._progress.add_task("training", total=total_frames, numbers="")
        self._progress.start()
        self._last_greedy = ""

    def log(self, row: Row) -> None:
        """Writes one log point; ``row["frames"]`` is its position, NaN a value that was not measured: an empty cell."""
        self.csv.write(row)
        row = measured(row)
        frames = int(row["frames"])
        for logger in self.loggers:
            logger.log_metrics(row, step=frames)
        evaluated = "greedy/return" in row
        if evaluated:
            ceiling = f" of {row['greedy/ceiling']:.2f}" if "greedy/ceiling" in row else ""
            success = f", success {row['greedy/success']:.0%}" if "greedy/success" in row else ""
            self._last_greedy = f"greedy {row['greedy/return']:+.2f}{ceiling}{success}"
        numbers = progress_line(row, self._last_greedy)
        self._progress.update(self._task, completed=frames, numbers=numbers)
        if evaluated and not self.console.is_terminal:
            self.console.print(f"{self.label}{frames:>9,} frames  {numbers}", highlight=False, soft_wrap=True)

    def say(self, sentence: str) -> None:
        """Prints a line above the progress bar."""
        self.console.print(f"{self.label}{sentence}", highlight=False, soft_wrap=True, markup=False)

    def state_dict(self) -> dict[str, Any]:
        """Its position in the files."""
        return {"csv": self.csv.state_dict(), "last_greedy": self._last_greedy}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a position; see :meth:`CSVLog.load_state_dict`."""
        self.csv.load_state_dict(state["csv"])
        self._last_greedy = state["last_greedy"]

    def close(self) -> None:
        """Stops the progress bar and ends the loggers: what they hold back is written."""
        self._progress.stop()
        for logger in self.loggers:
            logger.close()


def measured(row: Row) -> Row:
    """The values that are numbers; a mean over nothing is NaN, and is none.

    Examples:
        >>> measured({"frames": 8, "legs/start_to_0": float("nan")})
        {'frames': 8}
    """
    return {name: value for name, value in row.items() if math.isfinite(value)}


def progress_line(row: Row, greedy: str) -> str:
    """Speed, behaviour, greedy result and epsilons in one line."""
    updates = sum(value for name, value in row.items() if name.endswith("/updates_per_second"))
    epsilons = [
        f"{name.removesuffix('/epsilon')} {value:.2f}" for name, value in row.items() if name.endswith("/epsilon")
    ]
    parts = [f"{row.get('frames_per_second', 0):,.0f} frames/s, {updates:,.0f} updates/s"]
    if "behaviour/return" in row:
        parts.append(f"behaviour {row['behaviour/return']:+.2f}")
    return " | ".join([*parts, greedy, "epsilon " + ", ".join(epsilons)])


def make_tensorboard_logger(folder: Path) -> Logger:
    """TorchRL's TensorBoard logger, writing to ``folder/tensorboard``."""
    from torchrl.record.loggers.tensorboard import TensorboardLogger

    return TensorboardLogger("tensorboard", log_dir=str(folder))


def make_wandb_logger(
    folder: Path, *, project: str = "hdrqn_torchrl", offline: bool = False, settings: dict[str, Any] | None = None
) -> Logger:
    """TorchRL's Weights & Biases logger, writing to ``folder/wandb``.

    ``folder/wandb.json`` keeps the id of the W&B run: a resumed run goes on with it.

    Args:
        folder: run folder; its last two parts are the name of the W&B run.
        project: W&B project.
        offline: keeps everything in ``folder/wandb``; ``wandb sync`` uploads it later.
        settings: shown beside the curves.

    Raises:
        ImportError: if wandb is not installed.
    """
    _require("wandb")
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

    ``folder/mlflow.json`` keeps the id of the MLflow run: a resumed run goes on with it.

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
        logger.log_hparams(_flat(settings or {}))
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
    return json.loads(path.read_text())["id"] if path.exists() else None


def _record(path: Path, run_id: str) -> None:
    path.write_text(json.dumps({"id": run_id}) + "\n")


def _flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings under their full names, as MLflow wants its parameters."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat
