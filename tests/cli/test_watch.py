"""watch.py on a run folder as train.py leaves it: settings and checkpoints."""

import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from PIL import Image
from processes import ROOT

from hdrqn_torchrl.cli import recording, watch
from hdrqn_torchrl.cli.configuration import resolved
from hdrqn_torchrl.rendering import record_episodes, video
from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints
from hdrqn_torchrl.runs.persistence.weights import save_weights
from hdrqn_torchrl.runs.settings.building import build_algorithm

SMALL = ["env.max_steps=4", "network.hidden_size=8", "network.widths=[8]"]


def make_run(folder, algo="v2"):
    """A run folder whose best checkpoint is not its last one."""
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        config = compose("config", overrides=[f"algo={algo}", *SMALL])
    folder.mkdir()
    OmegaConf.save(config, folder / "config.yaml")
    checkpoints = Checkpoints(folder / "checkpoints")
    for step, score in ((1, 1.0), (2, 0.5)):
        torch.manual_seed(step)
        checkpoints.save(
            {"policy": build_algorithm(resolved(config), {"num_envs": 1})[1].policy}, step=step, score=score
        )
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("runs") / "v2")


@pytest.fixture
def command(monkeypatch, tmp_path, capsys):
    """Runs ``watch.py`` in this process, in an empty folder; returns what it printed."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["watch.py", *map(str, arguments)])
        watch.main()
        return capsys.readouterr().out

    return call


def error(command, *arguments):
    with pytest.raises(SystemExit) as caught:
        command(*arguments)
    return str(caught.value)


@pytest.mark.parametrize("algo", ["dqn", "drqn", "hdqn", "v1", "v2", "v3"])
def test_every_algorithm_can_be_watched(algo, tmp_path, command):
    run = make_run(tmp_path / "run", algo)
    printed = command(f"run={run}", "episodes=1", "seed=2")
    assert printed.startswith("episode 1: ") and "episode.gif: 5 frames, " in printed
    assert Image.open("episode.gif").n_frames == 5
    assert {path.name for path in tmp_path.iterdir()} == {"run", "episode.gif"}  # no partial file is left


def test_settings_change_what_is_played(run, command, monkeypatch):
    kept = []
    monkeypatch.setattr(recording, "write", lambda frames, path, fps: kept.append((frames, path, fps)))

    def played(*arguments):
        command(f"run={run}", *arguments)
        frames = kept[-1][0]
        return [(frame.action, frame.scene.state.agent.item()) for frame in frames], frames

    usual, frames = played()
    assert frames[-1].episode == 3 and kept[-1][1:] == (Path("episode.gif"), 4)
    assert played()[0] == usual
    for change in ("seed=1", "checkpoint=last", "epsilon=1.0", "env.layout=four_rooms"):
        assert played(change)[0] != usual, change
    assert played("checkpoint=best")[0] == usual
    assert len(played("episodes=1")[0]) == 5
    assert played("env.max_steps=2")[1][-1].max_steps == 2
    played("fps=9")
    assert kept[-1][2] == 9


def test_frames_are_those_of_the_loaded_weights(run, tmp_path, command, monkeypatch):
    """Against an agent built and loaded here."""
    config = OmegaConf.load(run / "config.yaml")
    env, algorithm = build_algorithm(resolved(config), {"num_envs": 1})
    torch.manual_seed(3)
    for parameter in algorithm.policy.parameters():
        torch.nn.init.normal_(parameter)
    save_weights(algorithm.policy, tmp_path / "mine.safetensors")
    expected = record_episodes(algorithm.transform(env), algorithm, episodes=2, seed=5)
    kept = []
    monkeypatch.setattr(recording, "write", lambda frames, path, fps: kept.extend(frames))
    command(f"run={run}", f"checkpoint={tmp_path / 'mine.safetensors'}", "episodes=2", "seed=5")
    assert [frame.action for frame in kept] == [frame.action for frame in expected]
    assert [frame.score for frame in kept] == [frame.score for frame in expected]


def test_a_picture_is_a_sheet_of_subgoals(run, command):
    assert command(f"run={run}", "out=sheet.png", "episodes=2") == "sheet.png: 2 episodes\n"
    assert Image.open("sheet.png").width > 500 and not list(Path().glob(".sheet*"))


def test_an_mp4_is_written_to_a_new_folder(run, command):
    pytest.importorskip("av")
    command(f"run={run}", "out=new/folder/episode.MP4", "episodes=1")
    assert Path("new/folder/episode.MP4").read_bytes()[4:8] == b"ftyp"


def test_episodes_can_be_shown_in_the_terminal(run, command):
    printed = command(f"run={run}", "out=terminal", "episodes=1")
    assert [printed.count(f"step {step} of 4") for step in range(6)] == [1, 1, 1, 1, 1, 0]
    assert "wants goal" in printed and "time is up" in printed
    assert not list(Path().iterdir())


def test_interrupting_the_show_is_not_an_error(run, command, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("hdrqn_torchrl.rendering.play_in_terminal", interrupted)
    command(f"run={run}", "out=terminal")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["out=episode.avi"], "error: out must end in .gif or .mp4, or be terminal, got 'episode.avi'"),
        (["episodes=0"], "error: episodes must be >= 1, got 0"),
        (["fps=0"], r"error: fps must lie in [1, 50], got 0"),
        (["epsilon=2"], "error: epsilon must lie in [0, 1], got 2.0"),
        (["env.views=3"], "error: env.KEY must be one of"),
        (["env.view=4"], "view must be an odd number of cells"),
        (["checkpoint=nowhere"], "error: checkpoint"),
        (["speed=3"], "the settings are run, out, episodes"),
        (["run=."], "error: run must be the folder of a training"),
    ],
    ids=str,
)
def test_wrong_settings_are_explained_and_write_nothing(run, command, arguments, message):
    assert message in error(command, f"run={run}", *arguments)
    assert not list(Path().iterdir())


def test_an_unwritable_place_is_found_before_playing(run, command, monkeypatch):
    monkeypatch.setattr(recording, "record", lambda settings: pytest.fail("played first"))
    Path("file").touch()
    assert "error: out must be a file that can be written, got 'file/episode.gif'" in error(
        command, f"run={run}", "out=file/episode.gif"
    )
    for wrong in ("out=x.avi", "fps=99"):
        error(command, f"run={run}", wrong)
    monkeypatch.setattr(video, "find_spec", lambda name: None)
    assert "pip install 'hdrqn_torchrl[video]'" in error(command, f"run={run}", "out=x.mp4")


def test_a_failed_write_leaves_the_old_file(run, command, monkeypatch):
    Path("episode.gif").write_text("old")

    def fail(frames, path, *, fps):
        path.write_text("half")
        raise OSError("disk full")

    monkeypatch.setattr("hdrqn_torchrl.rendering.write_video", fail)
    with pytest.raises(OSError, match="disk full"):
        command(f"run={run}")
    assert Path("episode.gif").read_text() == "old" and len(list(Path().iterdir())) == 1


def test_builders_of_other_packages_are_not_trusted(run, tmp_path, command):
    folder = make_run(tmp_path / "foreign")
    config = OmegaConf.load(folder / "config.yaml")
    config.env._target_ = "helpers.small_env"
    OmegaConf.save(config, folder / "config.yaml")
    assert "got 'helpers.small_env'" in error(command, f"run={folder}")


def test_help_does_not_load_torch():
    code = (
        "import runpy, sys; sys.argv = ['watch.py', '--help']\n"
        "try: runpy.run_path('watch.py', run_name='__main__')\n"
        "except SystemExit as end: assert end.code == 0 and 'torch' not in sys.modules"
    )
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    for setting in fields(watch.Settings):
        assert f"\n{setting.name} " in found.stdout or f"\n{setting.name}.KEY" in found.stdout
