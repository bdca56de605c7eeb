"""zoo.py: an agent made of a run, shown, copied, played."""

import json
import re
import shutil
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from PIL import Image
from run_folders import write_run
from safetensors.torch import load_file

from hdrqn_torchrl.analysis.zoo import add_agent, disagreement, score
from hdrqn_torchrl.cli import recording, zoo
from hdrqn_torchrl.cli.zoo import as_settings
from hdrqn_torchrl.rendering import excerpt, record_episodes
from hdrqn_torchrl.runs import load_agent
from hdrqn_torchrl.runs.cards import cards_of


def call(*arguments):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["zoo.py", *map(str, arguments)])
        zoo.main()


@pytest.fixture(scope="module")
def agents(tmp_path_factory):
    """A zoo with one agent, made of a run in a folder of its own."""
    folder = tmp_path_factory.mktemp("zoo")
    run = folder / "run"
    run.mkdir()
    write_run(run)
    overrides = ["env=gridworld", "algo=v2", f"hydra.run.dir={run}", "logger=csv", "seed=0"]
    origin = {"choices": {"env": "gridworld", "algo": "v2"}, "overrides": overrides, "commit": "abc"}
    (run / "run.json").write_text(json.dumps(origin))
    (run / "summary.json").write_text(json.dumps({"frames": 200}))
    call("add", "small-v2", f"run={run}", f"zoo={folder / 'zoo'}", "episodes=50")
    return folder / "zoo"


def test_a_card_says_what_an_agent_is_and_what_it_achieves(agents):
    (card,) = cards_of(agents)
    assert (card.name, card.task, card.algo, card.frames, card.episodes) == ("small-v2", "gridworld", "v2", 200, 50)
    assert card.command == "hdrqn train env=gridworld algo=v2 seed=0 total_frames=800_000" and card.commit == "abc"
    assert set(card.figures) == {"return_mean", "success_rate", "steps_mean"} == set(card.intervals)


def test_an_agent_is_a_run_with_weights_of_16_bits_in_place_of_checkpoints(agents):
    assert {path.name for path in (agents / "small-v2").iterdir()} == {
        "card.json",
        "config.yaml",
        "play.gif",
        "weights.safetensors",
    }
    stored = load_file(agents / "small-v2/weights.safetensors")
    assert {value.dtype for value in stored.values()} == {torch.float16, torch.int64}
    policy = load_agent(agents / "small-v2").algorithm.policy
    assert all(value.dtype == torch.float32 for value in policy.parameters())
    assert all(torch.equal(value, stored[name].to(value.dtype)) for name, value in policy.state_dict().items())


def test_an_agent_can_have_the_last_weights_instead_of_the_best(agents, tmp_path):
    stored = {}
    for checkpoint in ("best", "last"):
        run = agents.parent / "run"
        call("add", checkpoint, f"run={run}", f"zoo={tmp_path}", "episodes=2", f"checkpoint={checkpoint}")
        stored[checkpoint] = load_file(tmp_path / checkpoint / "weights.safetensors")
        weights = load_agent(run, checkpoint=checkpoint).algorithm.policy.state_dict()
        assert all(torch.equal(weights[name].to(value.dtype), value) for name, value in stored[checkpoint].items())
    assert any(not torch.equal(value, stored["last"][name]) for name, value in stored["best"].items())


def test_settings_of_an_agent_say_nothing_of_the_machine_that_it_was_trained_on(agents):
    assert (
        str(agents.parent)
        not in (agents / "small-v2/config.yaml").read_text() + (agents / "small-v2/card.json").read_text()
    )


def test_an_agent_stays_as_it_is_if_its_successor_comes_to_nothing(agents, tmp_path, monkeypatch):
    zoo_folder, run = tmp_path / "zoo", tmp_path / "run"
    shutil.copytree(agents, zoo_folder)
    shutil.copytree(agents.parent / "run", run)
    before = {path.name: path.read_bytes() for path in (zoo_folder / "small-v2").iterdir()}
    monkeypatch.setattr("hdrqn_torchrl.analysis.zoo.score", interrupted := Mock(side_effect=RuntimeError))
    with pytest.raises(RuntimeError):
        add_agent(run, zoo_folder, "small-v2")
    (run / "summary.json").unlink()
    with pytest.raises(SystemExit, match="run must be that of a finished training"):
        call("add", "small-v2", f"run={run}", f"zoo={zoo_folder}")
    assert interrupted.call_count == 1
    scores = [score(load_agent(agents / "small-v2", num_envs=2), episodes=2, seed=0), RuntimeError]
    monkeypatch.setattr("hdrqn_torchrl.analysis.zoo.score", Mock(side_effect=scores))
    shutil.copy(agents.parent / "run/summary.json", run)
    with pytest.raises(RuntimeError):  # when new weights have been written
        add_agent(run, zoo_folder, "small-v2")
    monkeypatch.setattr("hdrqn_torchrl.analysis.zoo.score", Mock(return_value=scores[0]))
    monkeypatch.setattr("hdrqn_torchrl.analysis.zoo.write_video", Mock(side_effect=OSError("no space")))
    with pytest.raises(SystemExit, match="no space"):  # when only picture and card are missing
        call("add", "small-v2", f"run={run}", f"zoo={zoo_folder}")
    assert {path.name: path.read_bytes() for path in (zoo_folder / "small-v2").iterdir()} == before
    assert [path.name for path in zoo_folder.iterdir()] == ["small-v2"]


def test_a_picture_shows_a_greedy_episode_to_its_end(agents):
    (card,) = cards_of(agents)
    agent = load_agent(agents / "small-v2")
    frames = record_episodes(agent.env, agent.algorithm, seed=card.worlds_seed)
    with Image.open(agents / "small-v2/play.gif") as picture:
        assert picture.size == (440, 264)
        assert picture.n_frames == len(excerpt(frames, 40)) <= 40


def test_the_page_of_all_agents_is_written_between_its_marks(agents, tmp_path, capsys):
    page = tmp_path / "docs/page.md"
    page.parent.mkdir()
    page.write_text("# Mine\n\n<!-- agents -->\noutdated\n<!-- end of agents -->\n\nAfter.\n")
    call("page", f"zoo={agents}", f"out={page}")
    text = page.read_text()
    assert text.startswith("# Mine\n\n<!-- agents -->\n| agent |") and text.endswith("-->\n\nAfter.\n")
    assert "outdated" not in text and "| [small-v2](#small-v2) | gridworld | v2 | 0k | 0 | abc | " in text
    (picture,) = re.findall(r"!\[Greedy play of small-v2\]\((.*)\)", text)
    assert (page.parent / picture).samefile(agents / "small-v2/play.gif")
    assert capsys.readouterr().out == f"{page}: small-v2\n"
    call("page", f"zoo={agents}", f"out={page}")
    assert page.read_text() == text


def test_a_score_agrees_with_the_card_unless_it_is_of_another_agent(agents):
    (card,) = cards_of(agents)
    agent = load_agent(agents / "small-v2", num_envs=20)
    scored = score(agent, episodes=20, seed=card.worlds_seed)
    assert disagreement(card, scored) == []
    wrong = disagreement(card, scored | {"steps_mean": 0.0})
    assert len(wrong) == 1 and wrong[0].startswith("steps_mean must be ")


def test_agents_are_listed_and_copied(agents, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    call("list", f"zoo={agents}")
    call("get", "small-v2", f"zoo={agents}", "out=mine")
    listed, evaluation = capsys.readouterr().out.splitlines()
    assert listed.startswith("small-v2 ") and "gridworld" in listed and "return " in listed
    assert evaluation.endswith("run=mine episodes=100") and load_agent("mine").config.env["view"] == 3


def test_an_agent_is_played_as_a_run_is(agents, monkeypatch):
    seen = []
    monkeypatch.setattr(recording, "run", seen.append)
    call("watch", "small-v2", f"zoo={agents}", "episodes=1", "seed=4", "out=a.mp4", "allowed_targets=[mine.Env]")
    played = recording.Settings(
        run=str(agents / "small-v2"), out="a.mp4", episodes=1, seed=4, allowed_targets=["mine.Env"]
    )
    assert seen == [played]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["bark"], r"action must be one of list, get, watch, add, page, got 'bark'"),
        (["get", "nobody"], r"name must be one of small-v2, got nobody"),
        (["watch"], r"name must be one of small-v2, got None"),
        (["add", "new"], r"run and name must be given"),
        (["add", "new", "run=nowhere"], r"run must be that of a finished training, got nowhere"),
        (["add", "new/er", "run=nowhere"], r"name must be that of one folder, got 'new/er'"),
        (["add", "..", "run=nowhere"], r"name must be that of one folder, got '\.\.'"),
    ],
)
def test_mistakes_are_told_and_leave_the_folder_as_it_was(agents, arguments, message):
    with pytest.raises(SystemExit, match=message):
        call(*arguments, f"zoo={agents}")
    assert [path.name for path in agents.iterdir()] == ["small-v2"]


@pytest.mark.parametrize(
    ("name", "zoo_folder", "message"),
    [
        ("run", "runs", "name must not be that of the run's own folder, got 'run'"),
        ("runs", ".", "name must not be that of the run's own folder, got 'runs'"),
        ("other", "runs", "name must be a new one, or that of an agent, which is then replaced, got 'other'"),
        ("texts", ".", "name must be a new one, or that of an agent, which is then replaced, got 'texts'"),
    ],
)
def test_an_agent_takes_the_place_of_nothing_but_an_agent(agents, tmp_path, monkeypatch, name, zoo_folder, message):
    for run in ("run", "other"):
        shutil.copytree(agents.parent / "run", tmp_path / "runs" / run)
    (tmp_path / "texts").mkdir()
    monkeypatch.setattr("hdrqn_torchrl.analysis.zoo.score", played := Mock())
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SystemExit, match=re.escape(message)):
        call("add", name, f"run={tmp_path / 'runs' / 'run'}", f"zoo={tmp_path / zoo_folder}")
    assert sorted(tmp_path.rglob("*")) == before and not played.called


def test_a_folder_without_agents_is_refused(tmp_path):
    with pytest.raises(SystemExit, match=r"zoo must be a folder of trained agents, got .*; a checkout has one"):
        call("list", f"zoo={tmp_path}")


def test_a_name_needs_no_key():
    assert as_settings(["add", "run=a", "b"]) == ["action=add", "name=b", "run=a"]
    assert as_settings(["--help"]) == ["--help"] and Path(zoo.FOLDER).name == "zoo"
