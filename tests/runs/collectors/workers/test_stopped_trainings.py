"""Whole trainings with workers that are stopped by Ctrl-C, or whose first process is killed."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from processes import ROOT
from programs import TINY, TINY_HDRQN, wait_until

LONG = ["algo=v2", *TINY, *TINY_HDRQN, "collector.workers=2", "evaluation.ceilings=false", "logger=csv"]
NEEDS_RAY = pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")


def frames(folder):
    metrics = folder / "run/metrics.csv"
    rows = csv.DictReader(metrics.read_text().splitlines()) if metrics.exists() else ()
    return [int(row["frames"]) for row in rows]


def started_by(session):
    """All processes of a session, and those that they started in sessions of their own."""
    listed = subprocess.run(["ps", "-eo", "sid=,ppid=,pid=,stat="], capture_output=True, text=True, check=True).stdout
    rows = [line.split() for line in listed.splitlines()]
    found = {int(pid) for sid, _, pid, stat in rows if int(sid) == session and not stat.startswith("Z")}
    for _ in range(5):
        found |= {int(pid) for _, parent, pid, stat in rows if int(parent) in found and not stat.startswith("Z")}
    return found


def alive(processes):
    return {pid for pid in processes if state(pid) != "Z"}


def state(pid):
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
        return stat.rpartition(")")[2].split()[0]
    except OSError:
        return "Z"


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL], ids=["ctrl-c", "killed"])
@pytest.mark.parametrize("kind", ["processes", pytest.param("ray", marks=NEEDS_RAY)])
def test_no_process_is_left_and_the_training_goes_on_with_all_workers(tmp_path, kind, number):
    def command(total, *more):
        settings = [f"collector={kind}", *LONG, f"total_frames={total}", "checkpoint.interval_frames=1000", *more]
        return [sys.executable, str(ROOT / "train.py"), *settings, "hydra.run.dir=run", "resume=auto"]

    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    with (tmp_path / "told.txt").open("w") as told:
        process = subprocess.Popen(
            command(200_000), cwd=tmp_path, env=environment, stdout=told, stderr=told, start_new_session=True
        )
    try:
        wait_until(lambda: process.poll() is not None or max(frames(tmp_path), default=0) >= 1500, 400)
        begun = started_by(process.pid)
        assert len(begun) >= 3  # it and its workers
        if number == signal.SIGINT:  # as a terminal sends it
            os.killpg(process.pid, number)
            assert process.wait(120) == 130, (tmp_path / "told.txt").read_text()
        else:
            process.kill()
            process.wait(10)
        wait_until(lambda: not alive(begun - {process.pid}), 120)
    finally:
        process.kill()
    before = frames(tmp_path)
    saved = max(int(path.name.rpartition("-")[2]) for path in tmp_path.glob("run/checkpoints/checkpoint-*"))
    assert saved >= (before[-1] if number == signal.SIGINT else 1000)
    done = subprocess.run(
        command(saved + 2000, "resume_override=true"),
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    after = frames(tmp_path)
    assert after == sorted(set(after)) and after[-1] >= saved + 2000
