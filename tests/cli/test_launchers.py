"""Jobs of sweeps that run elsewhere: with Ray, and with submitit's processes of this machine in place of Slurm."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra._internal.callbacks import Callbacks
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.types import HydraContext
from processes import run_script
from programs import ROOT, TINY, TINY_HDRQN, wait_until

from hdrqn_torchrl.cli import launchers, ledger, sweeps
from hdrqn_torchrl.cli.configuration import CONF

LONG = ["total_frames=6000", "log_frames=500", "evaluation.interval_frames=3000", "evaluation.ceilings=false"]
COMMON = ["algo=hdqn", "logger=csv", "hydra.sweep.dir=sweep", *TINY, *TINY_HDRQN, *LONG]
needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")
needs_submitit = pytest.mark.skipif(find_spec("submitit") is None, reason="submitit is not installed")


class Begun:
    """A sweep of one job whose task returns the setting ``resume``."""

    def __init__(self, folder, name, task=lambda config: config.resume):
        self.folder = folder
        with initialize_config_dir(str(CONF), version_base="1.3"):
            overrides = [f"sweep={name}", f"hydra.sweep.dir={folder}/sweep", f"hydra.runtime.cwd={folder}"]
            self.config = compose("config", overrides=overrides, return_hydra_config=True)
            loader = GlobalHydra.instance().config_loader()
        launchers.register()
        context = HydraContext(config_loader=loader, callbacks=Callbacks())
        self.launcher = Plugins.instance().instantiate_launcher(context, task, self.config)
        (folder / "sweep").mkdir()

    def note(self, job):
        note = {"job": job, "folder": "sweep/0-gridworld-hdqn-seed3", "state": "started"}
        (self.folder / "sweep" / "jobs.jsonl").write_text(json.dumps(note) + "\n")

    def run(self):
        return launchers.Job(self.launcher, 0, ["algo=hdqn", "seed=3"])().return_value

    def save(self):
        run = self.folder / "sweep" / "0-gridworld-hdqn-seed3"
        run.mkdir(exist_ok=True)
        (run / "config.yaml").touch()


@pytest.fixture(autouse=True)
def as_before(monkeypatch):
    """A job changes what belongs to its process."""
    monkeypatch.setattr(sweeps, "_stop", sweeps._Stop())
    former = {number: signal.getsignal(number) for number in (*sweeps.SIGNALS, signal.SIGUSR2)}
    folder, config = Path.cwd(), HydraConfig.instance().cfg
    yield
    os.chdir(folder)
    HydraConfig.instance().cfg = config
    for number, handler in former.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("name", ["ray", "slurm"])
class TestJob:
    def test_it_begins_anew(self, tmp_path, name):
        assert Begun(tmp_path, name).run() is None

    def test_it_goes_on_if_this_sweep_began_it_before(self, tmp_path, name):
        sweep = Begun(tmp_path, name)
        sweep.note(0)
        assert sweep.run() is None  # nothing was saved
        sweep.save()
        assert sweep.run() == "auto"

    def test_with_several_seeds_it_goes_on_if_any_of_them_was_saved(self, tmp_path, name):
        sweep = Begun(tmp_path, name)
        sweep.note(0)
        sweep.save()  # seed 3
        job = launchers.Job(sweep.launcher, 0, ["algo=hdqn", "seeds=2..3"])
        assert job().return_value == "auto"

    def test_the_run_of_an_earlier_sweep_is_left_alone(self, tmp_path, name):
        sweep = Begun(tmp_path, name)
        sweep.save()
        sweep.note(1)
        assert sweep.run() is None

    def test_one_that_left_no_result_is_told_and_does_not_end_the_others(self, tmp_path, name, capsys):
        job = launchers.Job(Begun(tmp_path, name).launcher, 0, ["algo=hdqn", "seed=3"])
        assert isinstance(job.lost(ValueError("its machine burns")).return_value, RuntimeError)
        assert capsys.readouterr().err == "job 0: ValueError: its machine burns\n"
        (note,) = ledger.read_ledger(tmp_path / "sweep" / "jobs.jsonl")
        assert note["folder"].endswith("sweep/0-gridworld-hdqn-seed3")
        job.lost(ValueError("so they say"))
        assert ledger.read_ledger(tmp_path / "sweep" / "jobs.jsonl") == [note]


@needs_ray
def test_a_sweep_without_a_cluster_ends_in_words(tmp_path):
    launcher = Begun(tmp_path, "ray").launcher
    launcher.address = "127.0.0.1:1"
    with pytest.raises(SystemExit, match=r"error: hydra\.launcher\.address must be .* cluster, got '127"):
        launcher.launch([["algo=hdqn"]], 0)


class TestPreemptedJob:
    def run(self, folder, task):
        requeued = []
        signal.signal(signal.SIGUSR2, lambda number, _: requeued.append(number))
        launchers.PreemptedJob(Begun(folder, "slurm", task).launcher, 0, ["algo=hdqn"])()
        return requeued

    def test_it_is_queued_again_after_it_has_saved_itself(self, tmp_path):
        saved = []

        def task(config):
            signal.signal(signal.SIGTERM, lambda number, _: saved.append(number))
            signal.raise_signal(signal.SIGUSR2)
            assert saved == [signal.SIGTERM]
            sweeps.end_stopped_job(143)

        assert self.run(tmp_path, task) == [signal.SIGUSR2]

    def test_it_is_not_if_it_was_done_all_the_same(self, tmp_path):
        def task(config):
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            signal.raise_signal(signal.SIGUSR2)

        assert self.run(tmp_path, task) == []

    def test_it_is_not_if_nobody_asked(self, tmp_path):
        assert self.run(tmp_path, lambda config: None) == []


def start(folder, *arguments):
    command = [sys.executable, str(ROOT / "train.py"), *COMMON, *arguments]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip


def process_of(folder, job=0):
    """The process that trains a job, by the lock of its run folder."""
    found = [json.loads(path.read_text() or "{}") for path in folder.glob(f"sweep/{job}-*/.lock")]
    return found[0].get("pid") if found else None


def logged(folder, job=0):
    path = next(iter(folder.glob(f"sweep/{job}-*/metrics.csv")), None)
    return [] if path is None else list(csv.DictReader(path.read_text().splitlines()))


def without_times(rows):
    return [
        {name: value for name, value in row.items() if not name.endswith(("_seconds", "_per_second"))} for row in rows
    ]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The rows of a training with a job's settings that nothing happens to."""
    folder = tmp_path_factory.mktemp("undisturbed")
    code, _, told = run_script(folder, *COMMON, "seed=0", "hydra.run.dir=sweep/0-alone")
    assert code == 0, told
    return without_times(logged(folder))


@needs_submitit
def test_a_preempted_job_of_submitit_saves_itself_and_nothing_is_done_twice(tmp_path, undisturbed):
    process = start(tmp_path, "sweep=slurm", "hydra.launcher.cluster=local", "seed=0")
    wait_until(lambda: len(logged(tmp_path)) >= 3)
    os.kill(first := process_of(tmp_path), signal.SIGUSR2)
    _, told = process.communicate(timeout=240)
    assert process.returncode == 0, told
    assert process_of(tmp_path) != first
    assert without_times(logged(tmp_path)) == undisturbed
    (output,) = (tmp_path / "sweep" / "slurm").glob("*.err")
    evaluated = [line.split()[1] for line in output.read_text().splitlines() if " frames/s" in line]
    assert len(evaluated) == len(set(evaluated)) == sum(bool(row["greedy/return"]) for row in undisturbed)
    assert not list((tmp_path / "sweep").rglob("*.pkl"))


@needs_submitit
@pytest.mark.slow
def test_a_preempted_job_with_several_seeds_goes_on_with_each_where_it_was(tmp_path, undisturbed):
    def of(seed):
        return csv.DictReader((tmp_path / f"sweep/0-gridworld-hdqn-seed{seed}/metrics.csv").read_text().splitlines())

    process = start(tmp_path, "sweep=slurm", "hydra.launcher.cluster=local", "seeds=0..2")
    wait_until(lambda: len(list(tmp_path.glob("sweep/0-*/metrics.csv"))) == 3 and len(list(of(2))) >= 3)
    os.kill(first := process_of(tmp_path), signal.SIGUSR2)
    _, told = process.communicate(timeout=400)
    assert process.returncode == 0, told
    assert process_of(tmp_path) != first
    assert without_times(of(0)) == undisturbed
    for seed in (1, 2):
        frames = [row["frames"] for row in of(seed)]
        assert frames == [row["frames"] for row in undisturbed]
        assert json.loads((tmp_path / f"sweep/0-gridworld-hdqn-seed{seed}/summary.json").read_text())["frames"] >= 6000
    assert [note["state"] for note in ledger.read_ledger(tmp_path / "sweep" / "jobs.jsonl")] == ["done"]


@needs_ray
def test_a_killed_job_of_ray_goes_on_elsewhere(tmp_path, undisturbed):
    process = start(tmp_path, "sweep=ray", "seed=0", "checkpoint.interval_frames=1000")
    wait_until(lambda: list(tmp_path.glob("sweep/*/checkpoints/checkpoint-*")) and len(logged(tmp_path)) >= 4)
    os.kill(first := process_of(tmp_path), signal.SIGKILL)
    _, told = process.communicate(timeout=240)
    assert process.returncode == 0, told
    assert process_of(tmp_path) != first
    assert without_times(logged(tmp_path)) == undisturbed
    assert [note["state"] for note in ledger.read_ledger(tmp_path / "sweep" / "jobs.jsonl")] == ["done"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(["sweep=ray"], marks=needs_ray),
        pytest.param(["sweep=slurm", "hydra.launcher.cluster=local"], marks=needs_submitit),
    ],
    ids=["ray", "submitit"],
)
def test_ctrl_c_saves_the_jobs_and_leaves_no_process_and_no_file(tmp_path, kind):
    before = processes()
    process = start(tmp_path, *kind, "seed=0,1", "total_frames=100000000")
    wait_until(lambda: all(len(logged(tmp_path, job)) >= 2 for job in (0, 1)))
    os.killpg(process.pid, signal.SIGINT)
    _, told = process.communicate(timeout=120)
    assert process.returncode == 130, told
    assert told.partition("\nunfinished: ")[2].count("    stopped by SIG") == 2, told
    assert len({path.parent for path in tmp_path.glob("sweep/*/checkpoints/checkpoint-*")}) == 2
    wait_until(lambda: not processes() - before, 60)
    assert not list((tmp_path / "sweep").rglob("*.pkl"))


def processes():
    """Those of Ray, of submitit, and of trainings, by number and command."""
    found = subprocess.run(["ps", "-ewwo", "pid=,args="], capture_output=True, text=True, check=True).stdout
    marks = ("raylet", "gcs_server", "ray::", "submitit", "hydra.sweep.dir=sweep")
    return {line for line in found.splitlines() if any(mark in line for mark in marks)}
