import csv
import io
import os
import sys
import time
from types import ModuleType, SimpleNamespace

import pytest
from rich.console import Console
from tensorboard.backend.event_processing import event_accumulator

from hdrqn_torchrl.runs.logging import (
    CSVLog,
    RunLogger,
    make_mlflow_logger,
    make_tensorboard_logger,
    make_wandb_logger,
    progress_line,
)

ROW = {"frames": 1_000, "frames_per_second": 2_000.0, "sub/updates_per_second": 30.0, "sub/epsilon": 0.5}
GREEDY = {"greedy/return": 1.25, "greedy/success": 0.5, "greedy/ceiling": 2.0}


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


class TestCSVLog:
    def test_a_new_column_keeps_the_old_rows(self, tmp_path):
        log = CSVLog(tmp_path / "metrics.csv")
        log.write({"frames": 1})
        log.write({"frames": 2, "loss": 0.5})
        log.write({"frames": 3, "loss": 0.25, "epsilon": 0.1})
        log.write({"frames": 4})
        assert read(log.path) == [
            {"frames": "1", "loss": "", "epsilon": ""},
            {"frames": "2", "loss": "0.5", "epsilon": ""},
            {"frames": "3", "loss": "0.25", "epsilon": "0.1"},
            {"frames": "4", "loss": "", "epsilon": ""},
        ]
        assert [path.name for path in tmp_path.iterdir()] == ["metrics.csv"]

    @pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
    def test_a_value_that_was_not_measured_is_an_empty_cell(self, tmp_path, value):
        log = CSVLog(tmp_path / "metrics.csv")
        log.write({"frames": 1, "legs/start_to_0": value, "loss": 0.5})
        log.write({"frames": 2, "legs/start_to_0": 0.25, "loss": 0.5})
        assert log.path.read_text() == "frames,legs/start_to_0,loss\n1,,0.5\n2,0.25,0.5\n"

    def test_the_order_of_a_rows_entries_does_not_matter(self, tmp_path):
        log = CSVLog(tmp_path / "metrics.csv")
        log.write({"a": 1, "b": 2})
        log.write({"b": 4, "a": 3})
        assert log.path.read_text() == "a,b\n1,2\n3,4\n"

    def test_an_existing_file_is_continued(self, tmp_path):
        CSVLog(tmp_path / "metrics.csv").write({"frames": 1, "loss": 0.5})
        CSVLog(tmp_path / "metrics.csv").write({"frames": 2, "epsilon": 1.0})
        assert read(tmp_path / "metrics.csv") == [
            {"frames": "1", "loss": "0.5", "epsilon": ""},
            {"frames": "2", "loss": "", "epsilon": "1.0"},
        ]

    @pytest.mark.parametrize("half", ["3,0.2", "3", '3,"0.2'])
    def test_half_a_row_of_a_killed_process_is_dropped(self, tmp_path, half):
        path = tmp_path / "metrics.csv"
        path.write_text(f"frames,loss\n1,0.5\n2,0.25\n{half}")
        log = CSVLog(path)
        assert log.rows == 2
        log.write({"frames": 3, "loss": 0.125})
        assert path.read_text() == "frames,loss\n1,0.5\n2,0.25\n3,0.125\n"

    def test_a_header_without_rows_is_kept(self, tmp_path):
        path = tmp_path / "metrics.csv"
        path.write_text("frames,loss")
        CSVLog(path).write({"frames": 1, "loss": 0.5})
        assert read(path) == [{"frames": "1", "loss": "0.5"}]

    def test_each_row_is_on_the_disk_when_it_is_written(self, tmp_path, monkeypatch):
        synced = []
        monkeypatch.setattr(
            "hdrqn_torchrl.runs.logging.os.fsync", lambda _: synced.append((tmp_path / "metrics.csv").exists())
        )
        log = CSVLog(tmp_path / "metrics.csv")
        log.write({"frames": 1})
        log.write({"frames": 2})
        assert synced == [False, True, True]  # the header before it has its name, then two rows


class TestPosition:
    """Where a resumed run continues in its table."""

    def log(self, path):
        log = CSVLog(path)
        log.write({"frames": 1})
        log.write({"frames": 2, "loss": 0.5})
        return log

    @pytest.mark.parametrize("later", ["", "3,0.25\n", "3,0.25\n4,0.1", "3,0.25\n4,0.1\n5,0.0\n"])
    def test_rows_after_the_stored_position_are_dropped(self, tmp_path, later):
        path = tmp_path / "metrics.csv"
        state = self.log(path).state_dict()
        with path.open("a") as file:
            file.write(later)
        log = CSVLog(path)
        log.load_state_dict(state)
        assert log.state_dict() == state == {"columns": ["frames", "loss"], "rows": 2}
        log.write({"frames": 3, "loss": 0.125})
        assert path.read_text() == "frames,loss\n1,\n2,0.5\n3,0.125\n"
        assert [each.name for each in tmp_path.iterdir()] == ["metrics.csv"]

    def test_columns_added_after_the_stored_position_are_dropped(self, tmp_path):
        path = tmp_path / "metrics.csv"
        log = self.log(path)
        state = log.state_dict()
        log.write({"frames": 3, "loss": 0.25, "late": 1.0})
        log = CSVLog(path)
        log.load_state_dict(state)
        log.write({"frames": 3, "loss": 0.25})
        assert path.read_text() == "frames,loss\n1,\n2,0.5\n3,0.25\n"

    def test_a_table_that_was_removed_starts_again(self, tmp_path):
        path = tmp_path / "metrics.csv"
        state = self.log(path).state_dict()
        path.unlink()
        log = CSVLog(path)
        log.load_state_dict(state)
        log.write({"frames": 3, "loss": 0.25})
        assert read(path) == [{"frames": "3", "loss": "0.25"}] and log.rows == 1

    def test_a_position_before_the_first_row_empties_the_table(self, tmp_path):
        path = tmp_path / "metrics.csv"
        state = CSVLog(path).state_dict()
        self.log(path)
        log = CSVLog(path)
        log.load_state_dict(state)
        log.write({"frames": 1})
        assert read(path) == [{"frames": "1"}]


class FakeLogger:
    def __init__(self):
        self.rows, self.closed = [], False

    def log_metrics(self, row, step):
        self.rows.append((row, step))

    def close(self):
        self.closed = True


def run_logger(folder, *, terminal=False, **settings):
    console = Console(file=io.StringIO(), force_terminal=terminal, width=200)
    return RunLogger(folder, total_frames=10_000, console=console, **settings), console


class TestRunLogger:
    def test_a_row_goes_to_the_table_and_to_every_logger(self, tmp_path):
        loggers = [FakeLogger(), FakeLogger()]
        logger, _ = run_logger(tmp_path, loggers=loggers)
        logger.log(ROW)
        logger.close()
        assert read(tmp_path / "metrics.csv")[0]["sub/epsilon"] == "0.5"
        for fake in loggers:
            assert fake.rows == [(ROW, 1_000)] and fake.closed

    def test_a_logger_that_fails_costs_no_more_than_its_own_point(self, tmp_path):
        class Failing:
            def __init__(self):
                self.got = []

            def log_metrics(self, row, step):
                if step == 2:
                    raise ConnectionError("no network")
                self.got.append(step)

            def flush(self):
                raise ConnectionError("still none")

            def close(self):
                raise ConnectionError("none at all")

        failing, console = Failing(), Console(file=io.StringIO())
        logger = RunLogger(tmp_path, total_frames=3, loggers=[failing], console=console)
        for frames in (1, 2, 3):
            logger.log({"frames": frames})
        logger.state_dict()
        logger.close()
        assert failing.got == [1, 3]
        assert (tmp_path / "metrics.csv").read_text().split() == ["frames", "1", "2", "3"]
        told = console.file.getvalue()
        assert f"warning: Failing failed (ConnectionError: no network); {tmp_path / 'metrics.csv'} has what" in told
        assert "still none" in told and "none at all" in told

    def test_without_a_terminal_each_greedy_evaluation_prints_one_line(self, tmp_path):
        logger, console = run_logger(tmp_path)
        logger.log(ROW)
        assert console.file.getvalue() == ""
        logger.log(ROW | GREEDY)
        logger.log(ROW)
        logger.close()
        lines = console.file.getvalue().splitlines()
        assert len(lines) == 1
        for part in ("1,000 frames", "greedy +1.25 of 2.00", "success 50%", "2,000 frames/s", "epsilon sub 0.50"):
            assert part in lines[0]

    def test_without_a_terminal_a_minute_without_a_line_ends_with_the_next_row(self, tmp_path, monkeypatch):
        logger, console = run_logger(tmp_path)
        now = time.monotonic()
        monkeypatch.setattr("hdrqn_torchrl.runs.logging.time.monotonic", lambda: now + 61)
        logger.log(ROW)
        logger.log(ROW)
        assert [line.split("  ")[0] for line in console.file.getvalue().strip().splitlines()] == ["1,000 frames"]

    def test_the_bar_moves_between_rows(self, tmp_path):
        logger, console = run_logger(tmp_path, terminal=True)
        logger.advance(500)
        logger.close()
        assert "500/10,000 frames" in console.file.getvalue()

    def test_a_terminal_shows_a_progress_bar(self, tmp_path):
        logger, console = run_logger(tmp_path, terminal=True)
        logger.log(ROW | GREEDY)
        logger.close()
        shown = console.file.getvalue()
        assert "1,000/10,000 frames" in shown and "greedy +1.25 of 2.00" in shown
        assert "    1,000 frames  " not in shown

    def test_the_position_of_a_logger_is_that_of_its_table_and_the_last_greedy_result(self, tmp_path):
        logger, _ = run_logger(tmp_path)
        logger.log(ROW | GREEDY)
        state = logger.state_dict()
        logger.log(ROW | GREEDY | {"greedy/return": 0.0})
        other, console = run_logger(tmp_path, terminal=True)
        other.load_state_dict(state)
        assert other.state_dict() == state and state["csv"]["rows"] == 1
        other.log(ROW)
        other.close()
        assert "greedy +1.25 of 2.00" in console.file.getvalue() and len(read(tmp_path / "metrics.csv")) == 2

    def test_a_run_without_a_ceiling_does_not_mention_one(self, tmp_path):
        logger, console = run_logger(tmp_path)
        logger.log(ROW | {"greedy/return": -0.5, "greedy/success": 0.0})
        assert "greedy -0.50, success 0%" in console.file.getvalue()


def test_the_progress_line_shows_speed_returns_and_epsilons():
    row = ROW | {"meta/updates_per_second": 5.0, "meta/epsilon": 0.25, "behaviour/return": 0.75}
    assert progress_line(row, "greedy +1.00") == (
        "2,000 frames/s, 35 updates/s | behaviour +0.75 | greedy +1.00 | epsilon sub 0.50, meta 0.25"
    )


def test_tensorboard_files_lie_in_the_run_folder(tmp_path):
    logger = make_tensorboard_logger(tmp_path)
    logger.log_scalar("loss", 0.5, step=3)
    assert list((tmp_path / "tensorboard").glob("events*"))


class TestTensorboardAfterAKill:
    """Frames that are done again appear once, in order."""

    def log(self, folder, steps, state=None):
        logger, _ = run_logger(folder, loggers=[make_tensorboard_logger(folder)])
        if state is not None:
            logger.load_state_dict(state)
        for step in steps:
            logger.log(ROW | {"frames": step, "loss": 1.0 / (1 + step)})
        return logger

    def points(self, folder):
        events = event_accumulator.EventAccumulator(str(folder / "tensorboard"))
        return [(point.step, round(point.value, 6)) for point in events.Reload().Scalars("loss")]

    def expected(self, steps):
        return [(step, round(1 / (1 + step), 6)) for step in steps]

    def test_a_resumed_run_logs_each_point_to_tensorboard_once(self, tmp_path):
        killed = self.log(tmp_path, range(3))
        state = killed.state_dict()
        assert self.points(tmp_path) == self.expected(range(3))  # a checkpoint leaves nothing unwritten
        killed.log(ROW | {"frames": 3, "loss": 7.0})
        killed.loggers[0].flush()
        self.log(tmp_path, [3, 4], state).close()
        assert self.points(tmp_path) == self.expected(range(5))

    def test_a_run_killed_before_its_first_checkpoint_logs_each_point_to_tensorboard_once(self, tmp_path):
        self.log(tmp_path, range(3)).close()
        (tmp_path / "metrics.csv").unlink()  # as a start from the beginning does
        self.log(tmp_path, range(2)).close()
        assert self.points(tmp_path) == self.expected(range(2))


def test_points_that_a_service_has_are_not_logged_twice(tmp_path):
    service = FakeLogger()
    service.logged_until = 1_000
    logger, _ = run_logger(tmp_path, loggers=[service])
    for frames in (500, 1_000, 1_500):
        logger.log(ROW | {"frames": frames})
    assert [step for _, step in service.rows] == [1_500]


SETTINGS = {"seed": 3, "algo": {"gamma": 0.9, "sub": {"tau": 0.5}}}


@pytest.mark.parametrize(
    ("package", "make"),
    [("wandb", make_wandb_logger), ("mlflow", lambda folder: make_mlflow_logger(folder, tracking_uri="sqlite:///x"))],
)
def test_a_missing_package_is_named_with_its_extra(package, make, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
    with pytest.raises(ImportError, match=rf"needs the package {package} .*pip install 'hdrqn_torchrl\[{package}\]'"):
        make(tmp_path)
    assert list(tmp_path.iterdir()) == []


class FakeService:
    """Stands in for TorchRL's logger of a service whose package need not be installed."""

    made: list

    def __init__(self, *args, **settings):
        number = len(self.made)
        self.args, self.settings, self.params = args, settings, None
        self.environment = os.environ.get("MLFLOW_RUN_ID")
        data = SimpleNamespace(metrics={"frames": 20})  # of a run that is gone on with
        self.experiment = SimpleNamespace(info=SimpleNamespace(run_id=f"run{number}"), data=data)
        self.made.append(self)

    def log_hparams(self, params):
        self.params = params


@pytest.fixture
def wandb_runs(monkeypatch):
    made = []
    monkeypatch.setitem(sys.modules, "wandb", ModuleType("wandb"))
    monkeypatch.setattr(
        "torchrl.record.loggers.wandb.WandbLogger", type("FakeWandb", (FakeService,), {"made": made}), raising=True
    )
    return made


class TestWandb:
    def test_it_lies_in_the_run_folder_and_is_named_after_it(self, wandb_runs, tmp_path):
        folder = tmp_path / "gridworld-v2" / "seed3"
        folder.mkdir(parents=True)
        make_wandb_logger(folder, project="mine", settings=SETTINGS)
        (run,) = wandb_runs
        assert run.args == ("gridworld-v2/seed3",) and run.params == SETTINGS
        assert (run.settings["project"], run.settings["save_dir"]) == ("mine", str(folder))

    def test_a_resumed_run_goes_on_and_another_does_not(self, wandb_runs, tmp_path):
        for folder in (tmp_path / "a", tmp_path / "b"):
            folder.mkdir()
            make_wandb_logger(folder)
        make_wandb_logger(tmp_path / "a")
        first, other, resumed = (run.settings["id"] for run in wandb_runs)
        assert first == resumed != other

    @pytest.mark.parametrize(("offline", "mode"), [(True, "offline"), (False, None)])
    def test_offline(self, wandb_runs, tmp_path, offline, mode):
        make_wandb_logger(tmp_path, offline=offline)
        assert wandb_runs[0].settings["mode"] == mode

    def test_the_real_one(self, tmp_path):
        pytest.importorskip("wandb")
        for folder in (tmp_path / "a", tmp_path / "b", tmp_path / "a"):
            folder.mkdir(exist_ok=True)
            logger = make_wandb_logger(folder, offline=True, settings=SETTINGS)
            logger.log_scalar("loss", 0.5, step=3)
            assert logger.experiment.config["algo"] == SETTINGS["algo"]
            assert logger.experiment.id in (folder / "wandb.json").read_text()
        logger.close()
        assert "WANDB_MODE" not in os.environ  # it would hold for the next run in this process
        assert [len(list((tmp_path / name).glob("wandb/offline-run-*"))) for name in "ab"] == [2, 1]


@pytest.fixture
def mlflow_runs(monkeypatch):
    made = []
    package = ModuleType("mlflow")
    for name in ("end_run", "set_tracking_uri", "set_experiment", "set_tag"):
        setattr(package, name, lambda *_, name=name: made.append((name, *_)))
    package.exceptions = SimpleNamespace(MlflowException=RuntimeError)
    monkeypatch.setitem(sys.modules, "mlflow", package)
    monkeypatch.setattr(
        "torchrl.record.loggers.mlflow.MLFlowLogger", type("FakeMLflow", (FakeService,), {"made": made}), raising=True
    )
    return made


class TestMLflow:
    def uri(self, tmp_path):
        return f"sqlite:///{tmp_path}/deep/mlflow.db"

    def make(self, runs, folder, uri, **settings):
        """The fake logger of one run, and what was asked of MLflow before and after it."""
        runs.clear()
        folder.mkdir(exist_ok=True)
        make_mlflow_logger(folder, tracking_uri=uri, **settings)
        (logger,) = (each for each in runs if isinstance(each, FakeService))
        return logger, [each for each in runs if each is not logger]

    def test_a_new_run(self, mlflow_runs, tmp_path):
        uri = self.uri(tmp_path)
        logger, asked = self.make(mlflow_runs, tmp_path / "seed3", uri, experiment="mine", settings=SETTINGS)
        assert asked == [
            ("end_run",),  # an earlier job's, in the same process
            ("set_tracking_uri", uri),
            ("set_experiment", "mine"),
            ("set_tag", "mlflow.runName", f"{tmp_path.name}/seed3"),
        ]
        assert logger.args == ("mine", uri) and logger.environment is None
        assert logger.params == {"seed": 3, "algo.gamma": 0.9, "algo.sub.tau": 0.5}
        assert (tmp_path / "deep").is_dir()

    def test_a_resumed_run_goes_on_and_another_does_not(self, mlflow_runs, tmp_path):
        first, _ = self.make(mlflow_runs, tmp_path / "a", self.uri(tmp_path), settings=SETTINGS)
        other, _ = self.make(mlflow_runs, tmp_path / "b", self.uri(tmp_path))
        resumed, asked = self.make(mlflow_runs, tmp_path / "a", self.uri(tmp_path), settings=SETTINGS)
        assert resumed.environment == first.experiment.info.run_id and other.environment is None
        assert resumed.params is None and ("set_tag",) not in {each[:1] for each in asked}  # they can't be changed
        assert "MLFLOW_RUN_ID" not in os.environ
        assert resumed.logged_until == 20 and not hasattr(other, "logged_until")

    def test_the_real_one(self, tmp_path):
        mlflow = pytest.importorskip("mlflow")
        for step, folder in enumerate((tmp_path / "a", tmp_path / "b", tmp_path / "a")):
            folder.mkdir(exist_ok=True)
            logger = make_mlflow_logger(folder, tracking_uri=self.uri(tmp_path), settings=SETTINGS)
            logger.log_scalar("loss", 0.5, step=step)
        mlflow.end_run()
        runs = mlflow.search_runs(experiment_names=["hdrqn_torchrl"], output_format="list")
        steps = {
            run.info.run_name: [each.step for each in mlflow.MlflowClient().get_metric_history(run.info.run_id, "loss")]
            for run in runs
        }
        assert steps == {f"{tmp_path.name}/a": [0, 2], f"{tmp_path.name}/b": [1]}
        assert runs[0].data.params == {"seed": "3", "algo.gamma": "0.9", "algo.sub.tau": "0.5"}
        with pytest.raises(ValueError, match=r"tracking_uri must be where .*; remove .*mlflow\.json"):
            make_mlflow_logger(tmp_path / "a", tracking_uri=f"sqlite:///{tmp_path}/other.db")
