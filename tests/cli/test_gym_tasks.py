"""The programs on a Gymnasium environment with subgoals of a user's own, named on the command line."""

import csv
import json
import sys

import pytest
from processes import run_script
from programs import TINY_HDRQN

from hdrqn_torchrl.cli import evaluate
from hdrqn_torchrl.cli.command_line import command_line
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.trust import check_targets, imports_of

ARGUMENTS = [
    *(
        "env=gym",
        "env.id=gym_toys:Counter-v0",
        "env.subgoals=gym_toys.Milestones",
        "env.num_envs=4",
        "env.max_steps=30",
    ),
    *("env.max_steps=30", "device=cpu", "total_frames=1000", "log_frames=500", "logger=csv", "network.hidden_size=8"),
    "network.widths=[8]",
    *(
        "evaluation.num_envs=4",
        "evaluation.episodes=4",
        "evaluation.final_episodes=4",
        "evaluation.interval_frames=500",
    ),
]
TRUSTED = "allowed_targets=[gym_toys,gym_toys.Milestones]"


def talk():
    """Makes every world print a line in every step."""
    import gym_toys

    shown = gym_toys.Counter._shown
    gym_toys.Counter._shown = lambda self: print("a world speaks") or shown(self)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    code, printed, told = run_script(folder, *ARGUMENTS, *TINY_HDRQN, "hydra.run.dir=run", prepare=talk)
    assert code == 0, told
    return folder / "run", printed, told


@pytest.fixture
def run(trained):
    return trained[0]


def evaluated(run, monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["evaluate.py", f"run={run}", "episodes=4", *arguments])
    command_line(evaluate.Settings, evaluate.__doc__, evaluate.run)


def test_what_a_command_names_is_trusted_and_both_levels_learn(run):
    with (run / "metrics.csv").open(newline="") as file:
        last = list(csv.DictReader(file))[-1]
    assert int(last["sub/updates"]) > 0 and int(last["meta/updates"]) > 0


def test_a_run_folder_imports_nothing_that_its_reader_does_not_trust(run, monkeypatch, capsys):
    with pytest.raises(SystemExit, match=r"import nothing that this program does not trust, got 'gym_toys"):
        evaluated(run, monkeypatch)
    evaluated(run, monkeypatch, TRUSTED)
    result = json.loads(capsys.readouterr().out)
    assert [each["name"] for each in result["per_subgoal"]] == ["five", "eight"]


@pytest.mark.parametrize(
    "settings",
    [
        {"subgoals": "os.system"},
        {"subgoals": ["mine.A", "mine.B"]},
        {"wrappers": ["mine.wrap"]},
        {"reward": "mine.paid"},
        {"success": "mine.done"},
        {"hazard": "mine.lost"},
        {"package": "mine"},
        {"id": "mine:Maze-v0"},
    ],
)
def test_every_setting_that_imports_is_refused_unless_it_is_allowed(settings):
    env = {"_target_": "hdrqn_torchrl.envs.make_gym", "id": "CartPole-v1", **settings}
    names = imports_of(env)
    assert names
    with pytest.raises(SettingsError, match="env must import nothing that this program does not trust"):
        check_targets(env, (), "env")
    check_targets(env, tuple(names), "env")


def test_entries_of_info_and_known_packages_import_nothing_of_a_users():
    env = {"_target_": "hdrqn_torchrl.envs.make_gym", "id": "ALE/Pong-v5", "package": "ale_py", "success": "is_success"}
    assert imports_of(env) == []


def test_worlds_that_print_leave_the_result_of_a_training_alone(trained):
    _, printed, told = trained
    assert json.loads(printed)["frames"] >= 1000 and "a world speaks" in told


def test_worlds_that_print_leave_the_result_of_an_evaluation_alone(run, monkeypatch, capsys):
    import gym_toys

    shown = gym_toys.Counter._shown
    monkeypatch.setattr(gym_toys.Counter, "_shown", lambda self: print("a world speaks") or shown(self))
    evaluated(run, monkeypatch, TRUSTED)
    printed = capsys.readouterr()
    assert json.loads(printed.out)["episodes"] == 4 and "a world speaks" in printed.err
