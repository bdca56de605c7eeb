import pytest
from helpers import make_training, table
from torchrl.checkpoint import CheckpointError

from hdrqn_torchrl.learning import PhaseOne


class Actions:
    """A user's monitor: the number of actions taken, in all and since the last row."""

    def __init__(self):
        self.total = self.recent = 0

    def observe(self, batch):
        self.total, self.recent = self.total + batch.numel(), self.recent + batch.numel()

    def metrics(self):
        return {"actions/total": self.total, "actions/recent": self.recent}

    def clear(self):
        self.recent = 0

    def state_dict(self):
        return {"total": self.total, "recent": self.recent}

    def load_state_dict(self, state):
        self.total, self.recent = state["total"], state["recent"]


def test_a_users_monitor_is_logged_cleared_and_stored(tmp_path):
    trainer = make_training(tmp_path, total_frames=192, evaluation_frames=10**6)
    trainer.algorithm.monitors["actions"] = Actions()
    trainer.train()
    rows = [(int(row["actions/total"]), int(row["actions/recent"])) for row in table(tmp_path)]
    assert rows == [(0, 0), (96, 96), (192, 96)]
    other = make_training(tmp_path, total_frames=192)
    other.algorithm.monitors["actions"] = Actions()
    other.resume(other.checkpoints.newest())
    assert (other.algorithm.monitors["actions"].total, other.algorithm.monitors["actions"].recent) == (192, 0)


def test_phases_stored_by_earlier_versions_are_refused_with_the_reason(tmp_path):
    trainer = make_training(tmp_path, options={"phase_one": PhaseOne()})
    phases, components = trainer.algorithm.monitors["phases"], trainer._parts
    trainer._saving._parts = lambda: {
        "phases" if name.startswith("monitor-phases") else name: phases if name.startswith("monitor-") else component
        for name, component in components().items()
        if name not in ("monitor-legs", "monitor-visits")
    }
    trainer.save()
    other = make_training(tmp_path, options={"phase_one": PhaseOne()})
    with pytest.raises(CheckpointError, match="must hold the counts of its phases in parts of their own, got"):
        other.resume(other.checkpoints.newest())
