import json
import os
import signal
import socket
import time
from types import SimpleNamespace

import pytest
from processes import start

from hdrqn_torchrl.runs.persistence.folder import locked, write_summary

RESULT = {"return_mean": 0.5, "success_rate": 0.25, "in_order_rate": 0.4, "steps_mean": 40.0, "episodes": 100}
CLOCK = SimpleNamespace(state_dict=lambda: {"wall_seconds": 12.3456, "processor_seconds": 9.876})
TRAINER = SimpleNamespace(frames=2_000, updates=30, episodes=50, clock=CLOCK)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "metrics.csv").write_text("frames,greedy/return\n0,0.25\n2000,0.5\n")
    return tmp_path


def test_the_summary_holds_result_counts_and_ceiling(folder):
    returned = write_summary(folder, TRAINER, RESULT, ceiling=1.9)
    summary = json.loads((folder / "summary.json").read_text())
    assert summary == returned
    expected = {"frames": 2_000, "updates": 30, "training_episodes": 50, "wall_seconds": 12.3, "ceiling": 1.9}
    expected |= {"processor_seconds": 9.9}
    assert summary == RESULT | expected
    assert {path.name for path in folder.iterdir()} == {"metrics.csv", "summary.json"}


def test_a_task_without_scripted_players_has_no_ceiling(folder):
    assert write_summary(folder, TRAINER, RESULT, ceiling=None)["ceiling"] is None
    assert json.loads((folder / "summary.json").read_text())["ceiling"] is None


def hold(folder):
    with locked(folder):
        (folder / "held").write_text("")
        time.sleep(60)


class TestLocked:
    def test_another_process_is_kept_out_until_it_ends_however_it_ends(self, tmp_path):
        process = start(hold, tmp_path / "run")
        deadline = time.monotonic() + 60
        while not (tmp_path / "run" / "held").exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        with (
            pytest.raises(
                ValueError, match=rf"run is in use: process {process.pid} on .* is training there; wait or stop it\."
            ),
            locked(tmp_path / "run"),
        ):
            raise AssertionError("both are in")
        os.kill(process.pid, signal.SIGKILL)
        process.join(30)
        with locked(tmp_path / "run"):
            pass

    def test_a_waiting_process_reports_who_holds_the_folder(self, tmp_path):
        reported = []
        with (
            locked(tmp_path),
            pytest.raises(ValueError, match="is in use"),
            locked(tmp_path, patience_seconds=0.3, tell=reported.append),
        ):
            raise AssertionError("both are in")
        who = f"process {os.getpid()} on {socket.gethostname()}"
        assert reported == [f"{tmp_path} is in use: waiting for {who}, which is training there"]

    def test_one_process_can_lock_a_folder_repeatedly(self, tmp_path):
        for _ in range(2):
            with pytest.raises(ZeroDivisionError), locked(tmp_path):
                _ = 1 / 0
        with (
            locked(tmp_path),
            pytest.raises(ValueError, match="is in use"),
            locked(tmp_path),
        ):
            raise AssertionError("both are in")

    @pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
    def test_something_other_than_a_lock_file_is_refused_and_a_link_is_not_followed(self, tmp_path, kind):
        (tmp_path / "mine").write_text("mine")
        (tmp_path / "run").mkdir()
        place = tmp_path / "run" / ".lock"
        {"link": lambda: place.symlink_to(tmp_path / "mine"), "pipe": lambda: os.mkfifo(place), "folder": place.mkdir}[
            kind
        ]()
        with pytest.raises(ValueError, match=r"\.lock must be what a run leaves there, got "), locked(tmp_path / "run"):
            raise AssertionError("it is in")
        assert (tmp_path / "mine").read_text() == "mine"

    def test_an_unwritable_folder_is_refused(self, tmp_path):
        (tmp_path / "file").write_text("")
        with (
            pytest.raises(
                ValueError, match=r"the run folder must be writable, got .*file/run \(.*\); choose another one"
            ),
            locked(tmp_path / "file" / "run"),
        ):
            raise AssertionError("it is in")
