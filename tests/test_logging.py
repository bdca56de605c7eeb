import csv
import io

from rich.console import Console

from hdrqn_torchrl.logging import CSVLog, RunLogger, make_tensorboard_logger, progress_line

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


class FakeLogger:
    def __init__(self):
        self.scalars = []

    def log_scalar(self, name, value, step):
        self.scalars.append((name, value, step))


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
            assert fake.scalars == [(name, value, 1_000) for name, value in ROW.items()]

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

    def test_on_a_terminal_there_is_a_bar_instead(self, tmp_path):
        logger, console = run_logger(tmp_path, terminal=True)
        logger.log(ROW | GREEDY)
        logger.close()
        shown = console.file.getvalue()
        assert "1,000/10,000 frames" in shown and "greedy +1.25 of 2.00" in shown
        assert "    1,000 frames  " not in shown

    def test_no_ceiling_no_mention_of_it(self, tmp_path):
        logger, console = run_logger(tmp_path)
        logger.log(ROW | {"greedy/return": -0.5, "greedy/success": 0.0})
        assert "greedy -0.50, success 0%" in console.file.getvalue()


def test_progress_line():
    row = ROW | {"meta/updates_per_second": 5.0, "meta/epsilon": 0.25, "behaviour/return": 0.75}
    assert progress_line(row, "greedy +1.00") == (
        "2,000 frames/s, 35 updates/s | behaviour +0.75 | greedy +1.00 | epsilon sub 0.50, meta 0.25"
    )


def test_tensorboard_files_lie_in_the_run_folder(tmp_path):
    logger = make_tensorboard_logger(tmp_path)
    logger.log_scalar("loss", 0.5, step=3)
    assert list((tmp_path / "tensorboard").glob("events*"))
