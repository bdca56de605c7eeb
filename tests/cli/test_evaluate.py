"""evaluate.py on a run of train.py."""

import json
import sys

import pytest
from processes import run_script
from programs import TINY, TINY_HDRQN

from hdrqn_torchrl.cli import evaluate
from hdrqn_torchrl.cli.command_line import command_line


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    code, _, told = run_script(folder, *TINY, *TINY_HDRQN, "logger=csv", "hydra.run.dir=run")
    assert code == 0, told
    return folder / "run"


@pytest.fixture
def call(run, monkeypatch, capsys):
    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["evaluate.py", f"run={run}", *arguments])
        command_line(evaluate.Settings, evaluate.__doc__, evaluate.run)
        return json.loads(capsys.readouterr().out)

    return call


def test_the_last_checkpoint_scores_as_in_the_final_evaluation_of_its_run(run, call):
    """The last checkpoint, played in the same worlds as the run's final evaluation."""
    result = call("checkpoint=last", "episodes=8", "num_envs=8")
    summary = json.loads((run / "summary.json").read_text())
    for name in ("return_mean", "intrinsic_mean", "success_rate", "steps_mean", "episodes", "frames", "ceiling"):
        assert result[name] == summary[name], name
    assert result["seed"] == 1_000_001  # not the 1_000_000 of the evaluations that chose the best checkpoint


def test_the_printed_result_holds_means_intervals_and_the_ceiling(call):
    result = call("episodes=32", "num_envs=16")
    assert result["episodes"] == 32 and result["epsilon"] == 0.0 and result["env"]["max_steps"] == 10
    for name, interval in result["intervals"].items():
        assert interval is None or interval[0] <= result[name] <= interval[1], name
    assert result["intervals"]["success_rate"] and result["intervals"]["intrinsic_mean"]
    assert [each["name"] for each in result["per_subgoal"]] == ["goal 1", "goal 2"]
    assert all(0 <= each["attained"] <= 1 for each in result["per_subgoal"])
    assert result["references"]["memory"]["return_mean"] == result["ceiling"]


def test_a_seed_repeats_and_another_differs(call):
    first, again, other = (call("episodes=64", f"seed={seed}") for seed in (1, 1, 2))
    assert first == again
    assert first["return_mean"] != other["return_mean"]


def test_epsilon_and_the_task_can_be_changed(call):
    greedy, random = call("episodes=64"), call("episodes=64", "epsilon=1")
    assert greedy["return_mean"] != random["return_mean"]
    longer = call("episodes=64", "epsilon=1", "env.max_steps=40")
    assert longer["steps_mean"] > 10 >= random["steps_mean"]
    assert longer["ceiling"] > random["ceiling"]


def test_legs_and_their_picture(call, tmp_path):
    result = call("episodes=32", "num_envs=16", "epsilon=0.5", f"figures={tmp_path}/figures")
    options, reached = result["legs"]["options"], result["legs"]["reached"]
    assert len(options) == 3 and all(
        len(row) == 2 for row in options
    )  # from each goal and from the start, to each goal
    assert sum(map(sum, options)) >= 32
    assert all(r <= o for row, told in zip(reached, options, strict=True) for r, o in zip(row, told, strict=True))
    assert [path.name for path in (tmp_path / "figures").iterdir()] == ["legs.png"]


def test_the_object_can_be_written_to_a_file(call, tmp_path):
    result = call("episodes=8", f"out={tmp_path / 'new' / 'result.json'}")
    assert json.loads((tmp_path / "new" / "result.json").read_text()) == result


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["episodes=0"], "episodes must be >= 1, got 0"),
        (["num_envs=0"], "num_envs must be >= 1, got 0"),
        (["seed=-1"], "seed must lie in \\[0, 1,000,000,000,000,000,000\\], got -1; leave it out"),
        (["seed=18446744073709551616"], "seed must lie in"),
        (["epsilon=2"], r"epsilon must lie in \[0, 1\], got 2"),
        (["episods=3"], "episods"),
        (["env.veiw=3"], r"env.KEY must be one of .*, got veiw"),
        (["env._target_=os.system"], r"env.KEY must be one of .*, got _target_"),
        (["env.view=4"], "env.view must be an odd number"),
        (
            ["env.num_goals=3"],
            r"env.num_goals=3 must not change .*, but .*, attained is bool \[3\] instead of",
        ),
        (
            ["env.view=3"],
            r"env.view=3 must not change .*, but observation is uint8 \[3, 3\] below 5 instead",
        ),
        (["checkpoint=nowhere"], "nowhere"),
        (["run=nowhere"], "run must be the folder of a training, got nowhere"),
        (["episodes=8", "out=/dev/null/result.json"], "out must be a file that can be written"),
        (["episodes=8", "figures=/dev/null/figures"], "figures must be a file that can be written"),
        (["episodes"], "must read key=value, got 'episodes'"),
    ],
)
def test_wrong_arguments_are_reported(call, arguments, part):
    with pytest.raises(SystemExit, match=part):
        call(*arguments)


@pytest.mark.parametrize("name", ["config.yaml", "metrics.csv"])
def test_no_file_of_a_run_is_written_over(call, run, name):
    before = (run / name).read_bytes()
    with pytest.raises(SystemExit, match="out must not be a file that a run consists of"):
        call(f"run={run}", "episodes=8", f"out={run / name}")
    assert (run / name).read_bytes() == before


def test_results_come_before_figures_and_survive_them(run, monkeypatch, capsys, tmp_path):
    def fail(*_):
        raise OSError("no room")

    monkeypatch.setattr(evaluate, "draw", fail)
    arguments = [f"run={run}", "episodes=8", "ceilings=false", f"figures={tmp_path / 'a #b'}", f"out={tmp_path}/1.json"]
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *arguments])
    with pytest.raises(SystemExit, match=r"error: out and figures must be .* \(no room\)"):
        command_line(evaluate.Settings, evaluate.__doc__, evaluate.run)
    result = json.loads(capsys.readouterr().out)
    assert result["episodes"] == 8 and json.loads((tmp_path / "1.json").read_text()) == result
    assert result["ceiling"] is None and result["references"] == {}


def test_help_is_printed_and_a_missing_argument_is_named(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "--help"])
    with pytest.raises(SystemExit) as stop:
        command_line(evaluate.Settings, evaluate.__doc__, evaluate.run)
    assert stop.value.code == 0 and "env.KEY" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "episodes=3"])
    with pytest.raises(SystemExit, match="run must be given"):
        command_line(evaluate.Settings, evaluate.__doc__, evaluate.run)
