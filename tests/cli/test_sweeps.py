"""Real sweeps, and the callback that keeps their ledger."""

import csv
import json
import os
import pickle
import signal
import subprocess
import sys
from multiprocessing.util import Finalize

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.utils import JobReturn, JobStatus
from omegaconf import OmegaConf
from processes import run_script
from programs import ROOT, TINY, TINY_HDRQN, call, wait_until

from hdrqn_torchrl.cli import ledger, sweeps
from hdrqn_torchrl.cli.configuration import CONF
from hdrqn_torchrl.runs.interruption import Interrupted

WRONG = "algo.gamma must lie in [0, 1], got 7"
COMMON = ["algo=hdqn", "logger=csv", "hydra.sweep.dir=sweep", *TINY, *TINY_HDRQN, "total_frames=600"]


def sweep(folder, *arguments):
    return call(folder, str(ROOT / "train.py"), *arguments, *COMMON)


def finish_as_a_program():
    """A forked process leaves out what was registered for the end of a program."""
    sweeps.atexit.register = lambda function, *arguments: Finalize(None, function, arguments, exitpriority=0)


def finished(folder):
    return sorted(path.parent.name.partition("-")[0] for path in (folder / "sweep").glob("*/summary.json"))


def rows_of(folder, job):
    """The rows that a job logged, without the columns that depend on its speed."""
    path = next((folder / "sweep").glob(f"{job}-*")) / "metrics.csv"
    with path.open(newline="") as file:
        return [
            {name: value for name, value in row.items() if not name.endswith(("_seconds", "_per_second"))}
            for row in csv.DictReader(file)
        ]


@pytest.fixture(scope="module")
def parallel(tmp_path_factory):
    """Two workers and six jobs, every second of which fails."""
    folder = tmp_path_factory.mktemp("parallel")
    arguments = ["-m", "sweep=parallel", "hydra.launcher.n_jobs=2", "seed=5,6,5", "algo.gamma=0.9,7"]
    return folder, sweep(folder, *arguments)


def test_failed_jobs_do_not_end_a_parallel_sweep(parallel):
    folder, done = parallel
    assert finished(folder) == ["0", "2", "4"]
    assert done.returncode == 1


def test_the_list_of_failed_jobs_comes_last(parallel):
    _, done = parallel
    assert done.stderr.partition("\nunfinished: ")[2].splitlines() == [
        "3 of 6 started jobs in sweep",
        "  sweep/1-gridworld-hdqn-seed5 (seed=5 algo.gamma=7)",
        f"    SettingsError: {WRONG}; the paper uses 0.99.",
        "  sweep/3-gridworld-hdqn-seed6 (seed=6 algo.gamma=7)",
        f"    SettingsError: {WRONG}; the paper uses 0.99.",
        "  sweep/5-gridworld-hdqn-seed5 (seed=5 algo.gamma=7)",
        f"    SettingsError: {WRONG}; the paper uses 0.99.",
        ledger.REMEDY,
    ]
    assert "Traceback" not in done.stderr


def test_nothing_leaks_from_job_to_job(parallel):
    """Job 0 is the first of its worker, job 4 comes after others."""
    folder, _ = parallel
    rows = rows_of(folder, 0)
    assert len(rows) > 2 and rows[-1]["greedy/return"]
    assert rows_of(folder, 4) == rows != rows_of(folder, 2)


@pytest.mark.slow
def test_a_serial_sweep_gives_the_same_and_survives_failed_jobs(parallel, tmp_path):
    done = sweep(tmp_path, "-m", "seed=5", "algo.gamma=7,0.9")
    assert finished(tmp_path) == ["1"] and done.returncode == 1
    told = done.stderr.partition("\nunfinished: ")[2].splitlines()
    assert told[:2] == ["1 of 2 started jobs in sweep", "  sweep/0-gridworld-hdqn-seed5 (algo.gamma=7)"]
    assert rows_of(tmp_path, 1) == rows_of(parallel[0], 0)


def test_a_job_that_goes_on_is_noted_with_the_folder_of_its_run(tmp_path):
    arguments = ["-m", *(each for each in COMMON if not each.startswith("hydra.")), "output_root=runs"]
    for more in ((), ("resume=auto",)):
        code, *_ = run_script(tmp_path, *arguments, *more)
        assert code == 0
    (run,) = tmp_path.glob("runs/*/0-*")
    ledgers = list(tmp_path.glob("runs/*/jobs.jsonl"))
    assert len(ledgers) == 2
    for path in ledgers:
        (note,) = ledger.read_ledger(path)
        assert note["folder"] == str(run.relative_to(tmp_path)) and note["state"] == ledger.DONE


def test_jobs_of_one_sweep_do_not_go_on_with_each_other(tmp_path):
    common = [each for each in COMMON if not each.startswith(("hydra.", "total_frames"))]
    arguments = ["-m", *common, "output_root=runs", "resume=auto", "total_frames=300,600"]
    for _ in range(2):  # the second finds the first one's runs, each its own
        assert run_script(tmp_path, *arguments)[0] == 0
    runs = [json.loads(path.read_text())["frames"] for path in tmp_path.glob("runs/*/*/summary.json")]
    assert len(runs) == 2 and sorted(frames // 300 for frames in runs) == [1, 2]


def test_a_search_maximises_and_survives_failed_trials(tmp_path):
    # Without -m: sweep=search alone says that this is a sweep.
    search = ["sweep=search", "hydra.sweeper.n_trials=4", "algo.gamma=choice(0.9,7)", "algo.sub.tau=0.02"]
    code, _, told = run_script(tmp_path, *search, *COMMON, prepare=finish_as_a_program)
    notes = ledger.read_ledger(tmp_path / "sweep" / "jobs.jsonl")
    failed = ledger.unfinished(notes)
    assert len(notes) == 4 and 0 < len(failed) < 4
    assert all(WRONG in note["state"] for note in failed) and f"unfinished: {len(failed)} of 4" in told
    assert code == 1
    returns = [json.loads(path.read_text())["return_mean"] for path in tmp_path.glob("sweep/*/summary.json")]
    best = OmegaConf.load(tmp_path / "sweep" / "optimization_results.yaml")
    assert best.best_value == pytest.approx(max(returns))
    assert set(best.best_params) == {
        "algo.gamma", "algo.sub.learning_rate", "algo.meta.learning_rate", "algo.sub_exploration.end",
    }  # fmt: skip
    for path in tmp_path.glob("sweep/*/config.yaml"):
        assert OmegaConf.load(path).algo.sub.tau == 0.02


@pytest.mark.slow
def test_a_search_runs_several_trials_at_once(tmp_path):
    several = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "hydra.sweeper.n_jobs=2", "hydra.sweeper.n_trials=4"]
    done = sweep(tmp_path, "-m", "sweep=search", *several)
    assert done.returncode == 0, done.stderr
    assert finished(tmp_path) == ["0", "1", "2", "3"]
    assert (tmp_path / "sweep" / "optimization_results.yaml").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("whole_group", [True, False], ids=["as Ctrl-C does", "the main process only"])
def test_a_stopped_parallel_sweep_saves_its_jobs(tmp_path, number, code, whole_group):
    endless = ["sweep=parallel", "hydra.launcher.n_jobs=2", "seed=0,1,2", "total_frames=100000000"]
    command = [sys.executable, str(ROOT / "train.py"), *COMMON, *endless]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        wait_until(lambda: len(list(tmp_path.glob("sweep/*/metrics.csv"))) == 2)
        (os.killpg if whole_group else os.kill)(process.pid, number)
        _, told = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == code, told
    assert told.partition("\nunfinished: ")[2].startswith("3 of 3 started jobs")
    assert told.count(f"    stopped by {signal.Signals(number).name}") == 2
    assert told.count("    not started, as the sweep was stopped") == 1
    assert len({path.parent for path in tmp_path.glob("sweep/*/checkpoints/*")}) == 2
    assert not list(tmp_path.glob("sweep/*/summary.json"))


@pytest.mark.slow
def test_a_killed_parallel_sweep_leaves_saved_jobs_and_the_same_command_goes_on(tmp_path):
    command = [sys.executable, str(ROOT / "train.py"), *COMMON, "sweep=parallel", "hydra.launcher.n_jobs=2", "seed=0,1"]
    command += ["resume=auto", "total_frames=12000", "evaluation.interval_frames=6000"]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL, text=True)
    wait_until(lambda: len(list(tmp_path.glob("sweep/*/metrics.csv"))) == 2)
    process.kill()
    process.wait()
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert finished(tmp_path) == ["0", "1"]
    for job in (0, 1):
        assert json.loads(next(tmp_path.glob(f"sweep/{job}-*/summary.json")).read_text())["frames"] == 12_000 + 32


@pytest.mark.slow
def test_a_stopped_serial_sweep_starts_no_more_jobs(tmp_path):
    command = [sys.executable, str(ROOT / "train.py"), "-m", *COMMON, "seed=0,1", "total_frames=100000000"]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    try:
        wait_until(lambda: list(tmp_path.glob("sweep/*/metrics.csv")))
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 130 and "1 of 1 started jobs" in told
    assert len(list(tmp_path.glob("sweep/*/checkpoints"))) == 1


class TestConfiguration:
    def configure(self, *overrides):
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return compose("config", overrides=list(overrides), return_hydra_config=True)

    @pytest.mark.parametrize("name", sorted(path.stem for path in (CONF / "sweep").glob("*.yaml")))
    def test_a_sweep_changes_only_how_jobs_are_run(self, name):
        plain, config = self.configure(), self.configure(f"sweep={name}")
        assert config.hydra.mode.name == "MULTIRUN" and plain.hydra.mode is None
        del plain.hydra, config.hydra
        assert config == plain

    def test_every_default_lies_in_the_searched_space(self):
        config = self.configure("sweep=search")
        for name, space in config.hydra.sweeper.params.items():
            low, high = map(float, space.rpartition("interval(")[2].rstrip(")").split(","))
            assert low < OmegaConf.select(config, name) < high, name


def job_config(folder, *, number=0, sweeper="hydra._internal.core_plugins.basic_sweeper.BasicSweeper", overrides=()):
    hydra = {
        "job": {"num": number},
        "runtime": {"output_dir": str(folder / f"job{number}"), "cwd": str(folder)},
        "overrides": {"task": list(overrides)},
        "sweeper": {"_target_": sweeper},
        "sweep": {"dir": str(folder), "subdir": f"job{number}"},
        "launcher": {"_target_": "hydra._internal.core_plugins.basic_launcher.BasicLauncher"},
    }
    return OmegaConf.create({"hydra": hydra})


def job_return(value):
    result = JobReturn(status=JobStatus.FAILED if isinstance(value, Exception) else JobStatus.COMPLETED)
    result.return_value = value
    return result


class Unpicklable(Exception):
    def __reduce__(self):
        raise TypeError("not to be pickled")


class TestCallback:
    @pytest.fixture
    def callback(self, tmp_path, monkeypatch):
        monkeypatch.setattr(sweeps.atexit, "register", lambda *_: None)
        callback = sweeps.Sweep()
        callback.on_multirun_start(job_config(tmp_path))
        return callback

    def test_the_ledger_of_an_earlier_sweep_in_the_same_folder_is_replaced(self, callback, tmp_path):
        callback.on_job_start(job_config(tmp_path))
        callback.on_multirun_start(job_config(tmp_path))
        assert ledger.read_ledger(callback.ledger) == []

    def test_a_folder_that_can_not_be_written_to_ends_it_before_it_begins(self, tmp_path):
        (tmp_path / "file").write_text("")
        config = OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path / "file" / "x")}}})
        with pytest.raises(SystemExit, match=r"^error: hydra\.sweep\.dir .* must be a folder that can be written to"):
            sweeps.Sweep().on_multirun_start(config)

    def test_a_single_run_is_left_alone(self, tmp_path):
        callback, result = sweeps.Sweep(), job_return(ValueError("x"))
        callback.on_job_start(job_config(tmp_path))
        callback.on_job_end(job_config(tmp_path), result)
        assert result.status == JobStatus.FAILED and list(tmp_path.iterdir()) == []

    def test_a_sweep_whose_jobs_are_done_does_not_exit_with_an_error(self, callback, tmp_path):
        result = job_return(1.5)
        callback.on_job_start(job_config(tmp_path))
        callback.on_job_end(job_config(tmp_path), result)
        callback.on_multirun_end(job_config(tmp_path))
        assert result.return_value == 1.5
        assert [note["state"] for note in ledger.read_ledger(callback.ledger)] == ["done"]

    def test_a_failed_job_does_not_reach_the_sweeper_that_would_raise_it(self, callback, tmp_path, capsys):
        result = job_return(ValueError("first line\nsecond line"))
        callback.on_job_start(job_config(tmp_path, number=3))
        callback.on_job_end(job_config(tmp_path, number=3), result)
        assert result.status == JobStatus.COMPLETED
        assert capsys.readouterr().err == "job 3: ValueError: first line\n"
        with pytest.raises(SystemExit) as stop:
            callback.on_multirun_end(job_config(tmp_path))
        assert stop.value.code == 1

    def test_a_search_sees_a_failed_job(self, callback, tmp_path):
        result = job_return(Unpicklable("out of memory"))
        callback.on_job_end(job_config(tmp_path, sweeper="hydra_plugins.optuna.OptunaSweeper"), result)
        assert result.status == JobStatus.FAILED
        with pytest.raises(RuntimeError, match="Unpicklable: out of memory"):
            _ = pickle.loads(pickle.dumps(result)).return_value

    def test_the_report_names_jobs_without_an_end(self, callback, tmp_path, capsys):
        for number in range(3):
            callback.on_job_start(job_config(tmp_path, number=number, overrides=["env=x", f"seed={number}"]))
        callback.on_job_end(job_config(tmp_path, number=1, overrides=["env=x", "seed=1"]), job_return(0.0))
        ledger.report(callback.ledger)
        lines = [line.strip() for line in capsys.readouterr().err.splitlines()]
        assert lines[1] == f"unfinished: 2 of 3 started jobs in {tmp_path}"
        assert [line.rpartition("/")[2] for line in lines[2:]] == [
            "job0 (seed=0)", "stopped or killed", "job2 (seed=2)", "stopped or killed", ledger.REMEDY,
        ]  # fmt: skip

    def test_a_note_that_was_torn_off_spoils_no_other(self, callback, tmp_path):
        callback.on_job_start(job_config(tmp_path, number=0))
        with callback.ledger.open("a") as file:
            file.write('{"job": 1, "st')
        callback.on_job_start(job_config(tmp_path, number=2))
        assert [note["job"] for note in ledger.read_ledger(callback.ledger)] == [0, 2]

    def test_no_report_without_unfinished_jobs(self, tmp_path, capsys):
        ledger.report(tmp_path / "jobs.jsonl")
        assert capsys.readouterr().err == ""


class TestStop:
    @pytest.fixture(autouse=True)
    def fresh(self, monkeypatch):
        former = {number: signal.getsignal(number) for number in sweeps.SIGNALS}
        monkeypatch.setattr(sweeps, "_stop", sweeps._Stop())
        yield
        for number, handler in former.items():
            signal.signal(number, handler)

    def worker(self, monkeypatch):
        monkeypatch.setattr(sweeps, "in_worker", lambda: True)

    def test_a_worker_at_work_leaves_its_job_and_takes_no_other(self, monkeypatch):
        self.worker(monkeypatch)
        sweeps._stop.watch_job()
        sweeps.refuse_if_stopped()
        with pytest.raises(Interrupted):
            signal.raise_signal(signal.SIGTERM)
        with pytest.raises(sweeps.JobStopped, match="not started"):
            sweeps.refuse_if_stopped()

    def test_an_idle_worker_stays_and_takes_no_other_job(self, monkeypatch):
        self.worker(monkeypatch)
        sweeps._stop.watch_job()
        sweeps._stop.in_job = False
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(sweeps.JobStopped, match="not started"):
            sweeps.refuse_if_stopped()

    def test_a_job_that_saved_itself_ends_its_worker_s_jobs(self, monkeypatch):
        self.worker(monkeypatch)
        with pytest.raises(sweeps.JobStopped, match="stopped by SIGTERM"):
            sweeps.end_stopped_job(143)
        with pytest.raises(sweeps.JobStopped, match="not started"):
            sweeps.refuse_if_stopped()

    @pytest.mark.parametrize("saving_polls", [0, 3])
    def test_a_worker_whose_sweep_was_killed_ends_when_its_job_has_saved_itself(self, monkeypatch, saving_polls):
        stop, parents, told = sweeps._stop, iter([7, 7, 1]), []
        stop.in_job = saving_polls > 0

        def sleep(_):
            told.append("sleep")
            if told.count("sleep") == 2 + saving_polls:
                stop.in_job = False

        monkeypatch.setattr(sweeps.time, "sleep", sleep)
        monkeypatch.setattr(sweeps.os, "getppid", lambda: next(parents))
        monkeypatch.setattr(sweeps.os, "kill", lambda _, number: told.append(number))
        monkeypatch.setattr(sweeps.os, "_exit", told.append)
        stop._watch_parent(7)
        assert told == ["sleep", "sleep", signal.SIGTERM, *["sleep"] * saving_polls, 143]
        assert stop.orphaned

    def test_an_orphan_leaves_the_ledger_to_the_sweep_that_was_started_since(self, tmp_path, monkeypatch):
        monkeypatch.setattr(sweeps.atexit, "register", lambda *_: None)
        callback = sweeps.Sweep()
        callback.on_multirun_start(job_config(tmp_path))
        sweeps._stop.orphaned = True
        callback.on_job_end(job_config(tmp_path), job_return(RuntimeError("stopped")))
        assert ledger.read_ledger(callback.ledger) == []

    def test_a_stopped_job_in_the_main_process_ends_the_program(self):
        with pytest.raises(SystemExit) as stop:
            sweeps.end_stopped_job(130)
        assert stop.value.code == 130
        sweeps.refuse_if_stopped()

    def test_the_main_process_passes_a_signal_on_once(self, monkeypatch):
        class Worker:
            pid = 123

        killed = []
        monkeypatch.setattr(sweeps.multiprocessing, "active_children", lambda: [Worker()])
        monkeypatch.setattr(sweeps.os, "kill", lambda *call: killed.append(call))
        signal.signal(signal.SIGINT, sweeps._stop.pass_on)
        signal.raise_signal(signal.SIGINT)
        assert killed == [(123, signal.SIGINT)]
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(SystemExit) as stop:
            sweeps.Sweep().on_multirun_end(OmegaConf.create())
        assert stop.value.code == 130
