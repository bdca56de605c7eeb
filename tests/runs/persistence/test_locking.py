import errno
import json
import os
import signal
import socket
import threading
import time

import pytest
from processes import start

from hdrqn_torchrl.runs.persistence import locking
from hdrqn_torchrl.runs.persistence.files import RunFileError
from hdrqn_torchrl.runs.persistence.locking import InUse, lock


@pytest.fixture(params=["flock", "no flock", "no fcntl"])
def system(request, monkeypatch):
    """A file system with locks, one without, and a system without any."""
    if request.param == "no fcntl":
        monkeypatch.setattr(locking, "fcntl", None)
    elif request.param == "no flock":
        monkeypatch.setattr(locking.fcntl, "flock", no_locks)
    return request.param


def no_locks(*_):
    raise OSError(errno.ENOLCK, "No locks available")


def refuse(path, **settings):
    with pytest.raises(InUse) as busy, lock(path, **settings):
        raise AssertionError("both are in")
    return busy.value.owner


def hold(path, with_flock):
    if not with_flock:
        locking.fcntl.flock = no_locks
    with lock(path):
        path.with_name("held").write_text("")
        time.sleep(60)


def test_a_lock_can_be_taken_again_after_its_release(tmp_path, system):
    for _ in range(2):
        with pytest.raises(ZeroDivisionError), lock(tmp_path / "x"):
            _ = 1 / 0
    with lock(tmp_path / "x"):
        assert refuse(tmp_path / "x").startswith(f"process {os.getpid()} on {socket.gethostname()}")
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


def test_two_locks_in_a_folder_are_independent(tmp_path, system):
    with lock(tmp_path / "x"), lock(tmp_path / "y"):
        pass


def test_a_waiting_process_gets_the_lock_and_reports_the_wait_once(tmp_path, system):
    told, inside = [], threading.Event()

    def stay():
        with lock(tmp_path / "x"):
            inside.set()
            time.sleep(0.5)

    thread = threading.Thread(target=stay)
    thread.start()
    assert inside.wait(10)
    with lock(tmp_path / "x", patience_seconds=30.0, tell=told.append):
        assert not thread.is_alive() or not thread.join(1)
    assert len(told) == 1 and told[0].startswith(f"process {os.getpid()} on ")


@pytest.mark.parametrize("with_flock", [True, False], ids=["flock", "file"])
def test_a_killed_process_leaves_no_lock(tmp_path, monkeypatch, with_flock):
    if not with_flock:
        monkeypatch.setattr(locking.fcntl, "flock", no_locks)
    process = start(hold, tmp_path / "x", with_flock)
    deadline = time.monotonic() + 60
    while not (tmp_path / "held").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert f"process {process.pid} on" in refuse(tmp_path / "x")
    os.kill(process.pid, signal.SIGKILL)
    process.join(30)
    with lock(tmp_path / "x"):
        pass


class TestOwnersFile:
    """Where the operating system has no locks."""

    @pytest.fixture(autouse=True)
    def without_locks(self, monkeypatch):
        monkeypatch.setattr(locking.fcntl, "flock", no_locks)

    def owner(self, tmp_path, **changes):
        owner = {"host": socket.gethostname(), "pid": os.getpid(), "started": locking._started(os.getpid())}
        (tmp_path / "x.owner").write_text(json.dumps(owner | changes))

    def test_a_process_with_the_id_of_a_dead_one_is_not_mistaken_for_it(self, tmp_path):
        self.owner(tmp_path)
        refuse(tmp_path / "x")
        self.owner(tmp_path, started=-1)
        with lock(tmp_path / "x"):
            pass

    def test_an_owner_on_another_machine_is_respected_and_the_message_says_what_to_do(self, tmp_path):
        self.owner(tmp_path, host="elsewhere", started=-1)
        told = refuse(tmp_path / "x")
        assert told.startswith(f"process {os.getpid()} on elsewhere (if no such process is there any more, remove ")
        assert told.endswith("x.owner)")

    @pytest.mark.parametrize("content", ["", "[1]", "{", '{"pid": "7", "host": 3}', "[" * 9_000, '{"pid": -1}'])
    def test_an_unreadable_owner_file_is_respected(self, tmp_path, content):
        (tmp_path / "x.owner").write_text(content)
        assert "remove" in refuse(tmp_path / "x")

    def test_a_pipe_in_place_of_the_owner_file_is_not_waited_for(self, tmp_path):
        os.mkfifo(tmp_path / "x.owner")
        assert "remove" in refuse(tmp_path / "x")

    def test_a_process_that_took_over_first_keeps_the_lock(self, tmp_path):
        self.owner(tmp_path)
        with pytest.raises(InUse):
            locking._take_over(tmp_path / "x.owner", {"host": "dead"})
        assert json.loads((tmp_path / "x.owner").read_text())["pid"] == os.getpid()


def test_the_target_of_a_link_is_left_alone(tmp_path):
    (tmp_path / "precious").write_text("kept")
    (tmp_path / "x").symlink_to(tmp_path / "precious")
    with pytest.raises(RunFileError, match="a symbolic link"), lock(tmp_path / "x"):
        raise AssertionError("it is in")
    assert (tmp_path / "precious").read_text() == "kept"


def test_other_errors_of_the_system_are_not_mistaken_for_missing_locks(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(locking.fcntl, "flock", fail)
    with pytest.raises(OSError, match="Input/output"), lock(tmp_path / "x"):
        raise AssertionError("it is in")
    assert not (tmp_path / "x.owner").exists()
