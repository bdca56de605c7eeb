import json
from types import SimpleNamespace

import pytest

from hdrqn_torchrl.run_folder import ceiling_of, write_results

REFERENCES = {"planner": {"return_mean": 2.0}, "memory": {"return_mean": 1.9, "steps_mean": 16.5}}
RESULT = {"return_mean": 0.5, "success_rate": 0.25, "in_order_rate": 0.4, "steps_mean": 40.0, "episodes": 100}
TRAINER = SimpleNamespace(frames=2_000, updates=30, episodes=50, wall_seconds=12.3456)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "metrics.csv").write_text("frames,greedy/return\n0,0.25\n2000,0.5\n")
    return tmp_path


def test_summary_and_picture(folder):
    returned = write_results(folder, TRAINER, RESULT, references=REFERENCES, title="a run")
    summary = json.loads((folder / "summary.json").read_text())
    assert summary == returned
    expected = {"frames": 2_000, "updates": 30, "training_episodes": 50, "wall_seconds": 12.3, "ceiling": 1.9}
    assert summary == RESULT | expected
    assert (folder / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert {path.name for path in folder.iterdir()} == {"metrics.csv", "summary.json", "curves.png"}


def test_a_task_without_scripted_players_has_no_ceiling(folder):
    assert write_results(folder, TRAINER, RESULT, references={})["ceiling"] is None
    assert json.loads((folder / "summary.json").read_text())["ceiling"] is None


def test_the_ceiling_is_that_of_the_player_with_the_agents_view():
    assert ceiling_of(REFERENCES) == 1.9
    assert ceiling_of({"planner": {"return_mean": 2.0}}) is None
