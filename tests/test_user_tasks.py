"""The programs on a user's task: no end, no success, no hazard, no order, no picture."""

import csv
import json
import sys

import numpy as np
import pytest
from processes import run_script
from programs import TINY_HDRQN
from user_envs import Pictured

from hdrqn_torchrl.algorithms import make_hdrqn, make_v3
from hdrqn_torchrl.cli import evaluate, plot, watch
from hdrqn_torchrl.cli.command_line import command_line
from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.rendering import draw_frame, record_episodes

TRUSTED = "allowed_targets=[user_envs.Corridor]"
TASK = [
    *("~env.layout", "~env.view", "~env.max_steps", "~env.obstacle", "~env.num_obstacles"),
    *("env._target_=user_envs.Corridor", TRUSTED),
    *("env.num_envs=4", "+env.pays=10.0", "device=cpu", "total_frames=1000", "log_frames=500", "logger=csv"),
    *("evaluation.num_envs=4", "evaluation.episodes=4", "evaluation.final_episodes=4", "network.hidden_size=8"),
    *("evaluation.interval_frames=500", "network.widths=[8]"),
]


def train(folder, *arguments):
    return run_script(folder, *TASK, *arguments, "hydra.run.dir=run")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    code, _, told = train(folder, *TINY_HDRQN, "+env.length=null", "evaluation.max_steps=20")
    assert code == 0, told
    return folder / "run"


def call(script, monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["program.py", *arguments])
    command_line(script.Settings, script.__doc__, script.run)


def test_both_levels_learn_on_a_users_task_and_evaluations_end(run):
    with (run / "metrics.csv").open(newline="") as file:
        last = list(csv.DictReader(file))[-1]
    assert int(last["sub/updates"]) > 0 and int(last["meta/updates"]) > 0
    assert (float(last["greedy/steps"]), float(last["greedy/cut_off"])) == (20.0, 1.0)
    assert not {"greedy/in_order", "greedy/success", "behaviour/in_order"} & set(last)
    summary = json.loads((run / "summary.json").read_text())
    assert not {"in_order_rate", "success_rate"} & set(summary) and summary["ceiling"] is None


def test_a_users_task_is_evaluated_and_plotted_without_optional_entries(run, tmp_path, monkeypatch, capsys):
    call(evaluate, monkeypatch, f"run={run}", "episodes=4", TRUSTED, f"figures={tmp_path}")
    result = json.loads(capsys.readouterr().out)
    assert result["cut_off_rate"] == 1.0 and "in_order_rate" not in result
    assert len(result["legs"]["options"]) == 3 and (tmp_path / "legs.png").stat().st_size > 1000
    for kind in ("curves", "greedy", "bars"):
        call(plot, monkeypatch, f"runs={run}", f"out={tmp_path / kind}.png", f"kind={kind}")
        assert (tmp_path / f"{kind}.png").stat().st_size > 1000


def test_a_users_task_is_watched_in_numbers_and_endless_episodes_are_cut_off(run, tmp_path, monkeypatch, capsys):
    call(watch, monkeypatch, f"run={run}", f"out={tmp_path}/episode.gif", "episodes=1", TRUSTED)
    told = capsys.readouterr().out
    assert "episode 1: time is up" in told and "20 steps" in told and (tmp_path / "episode.gif").stat().st_size > 1000


@pytest.mark.parametrize("algorithm", ["v1", "v2", "v3"])
def test_repeatable_subgoals_stay_available_and_rendered_pictures_are_watched(algorithm, tmp_path):
    env = Pictured(1)
    network = compact_network(8, (8,))
    agent = make_v3(env, network) if algorithm == "v3" else make_hdrqn(env, network, version=algorithm)
    steps = agent.transform(env).rollout(6, agent.policy)
    assert steps["subgoal_mask"].all()
    frames = record_episodes(agent.transform(Pictured(1)), agent)
    assert len(frames) == 7 and frames[0].scene.subgoal_names == ("west", "east")
    assert isinstance(frames[0].scene.rendered, np.ndarray) and draw_frame(frames[0]).shape[1] > 100


def test_missing_entries_are_reported_before_anything_is_trained(tmp_path):
    code, _, told = train(tmp_path, "algo=v3", "+env.without=[attained,success]")
    assert code == 1 and "Traceback" not in told
    assert "error: algo.env must have what make_v3 reads:" in told
    assert "'attained' must be [4, G] bool, it is missing" in told
