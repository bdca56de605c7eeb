"""check.py: the contract for tasks on the command line."""

import pytest
import torch
from helpers import small_env
from torchrl.data import Unbounded
from torchrl.envs import TransformedEnv
from user_envs import Corridor

from hdrqn_torchrl.cli import check
from hdrqn_torchrl.transforms import Critic


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Calls the program; returns its exit code and what it printed."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr("sys.argv", ["check.py", *arguments])
        with pytest.raises(SystemExit) as ended:
            check.main()
        return ended.value.code, capsys.readouterr().out

    return call


def test_a_task_of_the_package_has_no_fault_and_no_folder_is_made(run, tmp_path):
    code, printed = run("env=gridworld")
    assert code == 0 and printed.endswith("\nnothing is wrong or missing\n")
    assert "action: int64 [] below 4" in printed and "names of subgoals: goal 1" in printed
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("option", [["--config-dir", "my conf"], ["--config-dir=my conf"], ["-cd", "my conf"]])
def test_an_environment_of_a_users_configuration_folder_is_checked_wherever_the_folder_is_named(run, tmp_path, option):
    (tmp_path / "my conf" / "env").mkdir(parents=True)
    (tmp_path / "my conf" / "env" / "small.yaml").write_text("defaults:\n  - gridworld\n  - _self_\nmax_steps: 5\n")
    code, printed = run("env=small", *option, "env.max_steps=6")
    assert code == 0 and "longest episode: 6" in printed and printed.endswith("\nnothing is wrong or missing\n")


def test_a_faulty_environment_gives_exit_code_1(run, monkeypatch):
    monkeypatch.setattr(check, "check_settings", lambda *_, **__: ["wrong: 'reward' is missing (no agent)"])
    assert run("env=gridworld") == (1, "wrong: 'reward' is missing (no agent)\n")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["env=gym", "env.id=CartPole-v1", "algo=v3"], "wrong: algo.env must have what make_v3 reads"),
        (["env=gridworld", "algo=v3", "algo.levels=4"], "wrong: "),
        (["env=gridworld", "algo=v3"], "nothing is wrong"),
        (["env=gym", "env.id=CartPole-v1"], "missing: "),
    ],
    ids=str,
)
def test_an_agent_that_is_named_is_made_too(run, arguments, words):
    code, told = run(*arguments)
    assert code == words.startswith("wrong") and f"\n{words}" in told


def test_an_observation_that_the_network_can_not_read_gives_exit_code_1(run, monkeypatch):
    env = Corridor(4, odd={"observation": Unbounded((4, 3), dtype=torch.float64)})
    monkeypatch.setattr("hdrqn_torchrl.cli.check.build_env", lambda *_: env)
    code, told = run("env=gridworld")
    assert code == 1 and "\nwrong: 'observation' is not a square of cell codes" in told


def test_an_error_of_a_part_of_the_environment_is_told_without_a_traceback(run, monkeypatch):
    monkeypatch.setattr("hdrqn_torchrl.cli.check.build_env", lambda *_: TransformedEnv(small_env(4), Critic(2, len)))
    _, told = run("env=gridworld")
    assert "wrong: verdict must return which of num_subgoals=2 subgoals a step attained, [4, 2]" in told


@pytest.mark.parametrize(
    ("argument", "told"),
    [
        ("env.view=4", "error: env.view must be an odd number"),
        ("env._target_=mine.Env", "error: env._target_ must be one of the builders that this program trusts there"),
        ("env=nothing", "error: In 'config': Could not find 'env/nothing'"),
        ("env.veiw=4", "error: env.veiw must be a known setting; did you mean env.view? `python train.py"),
        ("+env.veiw=4", "error: env.veiw must be left out, got 4: hdrqn_torchrl.envs.MultiGoalGridEnv takes num_envs,"),
        ("--config-dir=nowhere", "error: --config-dir must be a folder, got 'nowhere'"),
    ],
)
def test_a_wrong_argument_is_reported(run, argument, told):
    code, _ = run(argument)
    assert code.startswith(told) and "\n" not in code


def test_help_shows_the_usage(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["hdrqn check", "--help"])
    check.main()
    assert "hdrqn check env=gridworld" in capsys.readouterr().out
