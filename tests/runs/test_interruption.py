import os
import signal
import threading
import time

import pytest
from processes import start

from hdrqn_torchrl.runs.interruption import SIGNALS, Interrupted, StopRequest


@pytest.mark.parametrize(("number", "name", "code"), [(signal.SIGINT, "SIGINT", 130), (signal.SIGTERM, "SIGTERM", 143)])
class TestOneSignal:
    def test_a_stop_signal_waits_for_the_next_check(self, number, name, code):
        passed = False
        with StopRequest() as stop:
            stop.check()
            signal.raise_signal(number)
            passed = True
            with pytest.raises(Interrupted, match=f"^stopped by {name}$") as reason:
                stop.check()
        assert passed and (reason.value.number, reason.value.exit_code) == (number, code)

    def test_a_second_stop_signal_does_not_wait(self, number, name, code, monkeypatch):
        clock = [100.0]
        monkeypatch.setattr(time, "monotonic", lambda: clock[0])
        with StopRequest():
            signal.raise_signal(number)
            clock[0] += 0.9
            signal.raise_signal(number)  # still the same request: a terminal and a parent process both passed it on
            clock[0] += 0.2
            with pytest.raises(KeyboardInterrupt) as reason:
                signal.raise_signal(number)
        assert not isinstance(reason.value, Interrupted)


def test_a_new_request_forgets_the_last_one():
    stop = StopRequest()
    with stop:
        signal.raise_signal(signal.SIGTERM)
    with stop:
        stop.check()


def test_signal_handlers_are_restored():
    def mine(*_):
        pass

    former = [signal.signal(number, mine) for number in SIGNALS]
    try:
        with pytest.raises(ZeroDivisionError), StopRequest():
            assert all(signal.getsignal(number) is not mine for number in SIGNALS)
            _ = 1 / 0
        assert all(signal.getsignal(number) is mine for number in SIGNALS)
    finally:
        for number, handler in zip(SIGNALS, former, strict=True):
            signal.signal(number, handler)


def test_signals_are_left_alone_in_another_thread():
    seen = []

    def work():
        with StopRequest() as stop:
            stop.check()
            seen.append([signal.getsignal(number) for number in SIGNALS])

    before = [signal.getsignal(number) for number in SIGNALS]
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]


def wait_for_signals(path):
    with StopRequest() as stop:
        path.write_text("ready")
        while True:
            time.sleep(0.01)
            stop.check()


@pytest.mark.parametrize("number", SIGNALS)
def test_a_stop_that_nobody_catches_ends_the_process_with_exit_code_1(tmp_path, number):
    """In a process of its own."""
    process = start(wait_for_signals, tmp_path / "ready")
    deadline = time.monotonic() + 60
    while not (tmp_path / "ready").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(process.pid, number)
    process.join(30)
    assert process.exitcode == 1
