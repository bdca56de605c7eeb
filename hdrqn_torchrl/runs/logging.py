"""Where the numbers of a run go: one CSV row per log point, TensorBoard scalars, a progress line."""

from __future__ import annotations

import csv
import math
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from torchrl.record.loggers.common import Logger

from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.files import open_file, read_bytes, read_text, replaced
from hdrqn_torchrl.runs.services import make_mlflow_logger, make_tensorboard_logger, make_wandb_logger

__all__ = ["CSVLog", "RunLogger", "make_mlflow_logger", "make_tensorboard_logger", "make_wandb_logger"]

Row = dict[str, float]


_QUIET_SECONDS = 60.0


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
            self.columns, rows = self._read()
            self.rows = len(rows)
            if not read_bytes(path).endswith(b"\n"):
                self._rewrite(self.columns)  # the next row would be appended to half of one

    def write(self, row: Row) -> None:
        """Appends one row; it is on the disk when this returns."""
        if new := [name for name in row if name not in self.columns]:
            self._widen(new)
        with open_file(self.path, "a", newline="") as file:
            csv.DictWriter(file, self.columns, restval="", lineterminator="\n").writerow(measured(row))
            file.flush()
            os.fsync(file.fileno())
        self.rows += 1

    def _widen(self, new: list[str]) -> None:
        self._rewrite([*self.columns, *new])

    def _read(self) -> tuple[list[str], list[list[str]]]:
        """Columns and all whole rows; a killed process may have left half of one at the end."""
        text = read_text(self.path) if self.path.exists() else ""
        columns, *rows = list(csv.reader(text[: text.rfind("\n") + 1].splitlines())) or [[]]
        return columns, rows

    def last_frames(self) -> int:
        """``frames`` of the last row; -1 if there is none."""
        columns, rows = self._read()
        return int(dict(zip(columns, rows[-1], strict=False)).get("frames", "-1")) if rows else -1

    def _rewrite(self, columns: list[str], until: int | None = None) -> None:
        """Writes the file anew with these columns and the first rows."""
        before, rows = self._read()
        rows = rows[:until]
        self.columns, self.rows = columns, len(rows)
        with replaced(self.path) as partial, partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns, restval="", extrasaction="ignore", lineterminator="\n")
            writer.writeheader()
            writer.writerows(dict(zip(before, row, strict=False)) for row in rows)

    def state_dict(self) -> dict[str, Any]:
        """Its position: columns and number of rows."""
        return {"columns": list(self.columns), "rows": self.rows}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a position: later rows are dropped from the file, as they will be written again.

        Raises:
            ValueError: if it is not a valid position.
        """
        columns, rows = list(state["columns"]), state["rows"]
        if not all(isinstance(name, str) for name in columns) or type(rows) is not int or rows < 0:
            raise ValueError("the stored place in metrics.csv must be columns and rows, got others; use another one.")
        if self.path.exists():
            self._rewrite(columns, rows)


class RunLogger:
    """Sends each log point to the CSV file, to TorchRL loggers and to the terminal.

    A logger that fails at a log point (W&B without a network) is told of and misses it: the file has all of them, and
    the training goes on.

    Args:
        folder: run folder; it is made if it is not there.
        total_frames: end of the progress bar.
        loggers: any TorchRL loggers (TensorBoard, W&B, ...); scalars are logged under their column's name.
        console: where progress goes; a terminal shows a bar, anything else a line per greedy evaluation, and for one
            of the log points in between if there was none for a minute.
        label: put before those lines, to tell the runs of a sweep apart.
        bar: whether a terminal shows a bar.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> logger = RunLogger(folder, total_frames=100)
        >>> logger.log({"frames": 50, "sub/loss": 0.5})
        >>> logger.close()
        >>> (folder / "metrics.csv").read_text().split()
        ['frames,sub/loss', '50,0.5']
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        total_frames: int,
        loggers: list[Logger] | None = None,
        console: Console | None = None,
        label: str = "",
        bar: bool = True,
    ) -> None:
        self.label = f"{label}  " if label else ""
        Path(folder).mkdir(parents=True, exist_ok=True)
        self.csv, self.loggers = CSVLog(Path(folder) / layout.METRICS), loggers or []
        self.console = console or Console(file=sys.stderr)
        self._bar = bar and self.console.is_terminal
        self._progress = Progress(
            TextColumn("{task.percentage:>3.0f}%"),
            BarColumn(bar_width=20),
            TaskProgressColumn(text_format="{task.completed:,.0f}/{task.total:,.0f} frames", show_speed=False),
            TimeRemainingColumn(),
            TextColumn("{task.fields[numbers]}"),
            console=self.console,
            disable=not self._bar,
        )
        self._task = self._progress.add_task("training", total=total_frames, numbers="")
        self._progress.start()
        self._last_greedy = ""
        self._last_line = time.monotonic()
        self._going = False

    def log(self, row: Row) -> None:
        """Writes one log point; ``row["frames"]`` is its position, NaN a value that was not measured: an empty cell."""
        self._go_on()
        self.csv.write(row)
        row = measured(row)
        frames = int(row["frames"])
        for logger in self.loggers:
            if frames > getattr(logger, "logged_until", -1):
                with self._going_on_without(logger):
                    logger.log_metrics(row, step=frames)
        evaluated = "greedy/return" in row
        if evaluated:
            ceiling = f" of {row['greedy/ceiling']:.2f}" if "greedy/ceiling" in row else ""
            success = f", success {row['greedy/success']:.0%}" if "greedy/success" in row else ""
            self._last_greedy = f"greedy {row['greedy/return']:+.2f}{ceiling}{success}"
        numbers = progress_line(row, self._last_greedy)
        self._progress.update(self._task, completed=frames, numbers=numbers)
        if not self._bar and (evaluated or time.monotonic() >= self._last_line + _QUIET_SECONDS):
            self.console.print(f"{self.label}{frames:>9,} frames  {numbers}", highlight=False, soft_wrap=True)
            self._last_line = time.monotonic()

    def advance(self, frames: int) -> None:
        """Moves the progress bar; the numbers beside it stay those of the last log point."""
        self._progress.update(self._task, completed=frames)

    def _go_on(self) -> None:
        """Before the first row: loggers that can go back to the last row of the table do so."""
        if not self._going:
            last = self.csv.last_frames()
            for logger in self.loggers:
                if hasattr(logger, "go_back_to"):
                    with self._going_on_without(logger):
                        logger.go_back_to(last)
            self._going = True

    def say(self, sentence: str) -> None:
        """Prints a line above the progress bar."""
        self.console.print(f"{self.label}{sentence}", highlight=False, soft_wrap=True, markup=False)

    def state_dict(self) -> dict[str, Any]:
        """Its position in the files; what loggers have buffered is written, too."""
        for logger in self.loggers:
            if hasattr(logger, "flush"):
                with self._going_on_without(logger):
                    logger.flush()
        return {"csv": self.csv.state_dict(), "last_greedy": self._last_greedy}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a position; see :meth:`CSVLog.load_state_dict`."""
        self.csv.load_state_dict(state["csv"])
        self._last_greedy = state["last_greedy"]

    def close(self) -> None:
        """Stops the progress bar and ends the loggers: what they have buffered is written."""
        self._progress.stop()
        for logger in self.loggers:
            with self._going_on_without(logger):
                logger.close()

    @contextmanager
    def _going_on_without(self, logger: Logger) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # whatever a service may raise
            reason = f"{type(error).__name__}: {error}"
            self.say(f"warning: {type(logger).__name__} failed ({reason}); {self.csv.path} has what it missed")


def measured(row: Row) -> Row:
    """The values that are numbers; a mean over nothing is NaN and is left out.

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
