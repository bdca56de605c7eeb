"""The clock of a training."""

import time

from hdrqn_torchrl.runs.clock import Clock


def test_it_goes_on_from_what_was_stored_by_earlier_versions_too(monkeypatch):
    now = {"monotonic": 100.0, "process_time": 7.0}
    for name in now:
        monkeypatch.setattr(time, name, lambda name=name: now[name])
    clock = Clock()
    now["monotonic"], now["process_time"] = 110.0, 12.0
    stored = clock.state_dict()
    assert stored == {"wall_seconds": 10.0, "processor_seconds": 5.0}
    later = Clock()
    later.load_state_dict(stored)
    now["process_time"] = 13.0
    assert later.state_dict() == {"wall_seconds": 10.0, "processor_seconds": 6.0}
    later.load_state_dict({"wall_seconds": 3.0})  # before processor time was stored
    assert later.state_dict() == {"wall_seconds": 3.0, "processor_seconds": 0.0}
