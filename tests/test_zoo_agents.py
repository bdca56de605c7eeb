"""Agents that come with the checkout are whole, and achieve what their cards say."""

import shlex

import pytest
from PIL import Image

from hdrqn_torchrl.analysis.gallery import gallery
from hdrqn_torchrl.analysis.zoo import FRAMES, WORLDS, disagreement, score
from hdrqn_torchrl.cli.check import composed
from hdrqn_torchrl.cli.marks import put
from hdrqn_torchrl.cli.zoo import FOLDER, MARK
from hdrqn_torchrl.runs import load_agent
from hdrqn_torchrl.runs.cards import cards_of

OWN = {"cartpole-positions-drqn": ["examples.own_task.positions.positions"]}
"""Builders that an agent's task names besides the package's."""
NEEDED = (("MiniGrid", "minigrid"), ("BabyAI", "minigrid"), ("montezuma", "ale_py"))
LARGEST, LARGEST_PLAY = 20_000_000, 250_000  # bytes of all agents, and of one's play.gif
CARDS = cards_of(FOLDER)


@pytest.mark.parametrize(
    "card",
    [pytest.param(card, id=card.name, marks=[] if card.task == "gridworld" else pytest.mark.slow) for card in CARDS],
)
def test_an_agent_achieves_what_its_card_says(card):
    for start, package in NEEDED:
        if card.task.startswith(start):
            pytest.importorskip(package)
    agent = load_agent(FOLDER / card.name, num_envs=WORLDS, allowed_targets=OWN.get(card.name, ()))
    assert disagreement(card, score(agent, episodes=100, seed=card.worlds_seed)) == []


def test_agents_take_little_room_and_are_whole():
    assert sum(path.stat().st_size for path in FOLDER.rglob("*")) < LARGEST
    assert {path.name for path in FOLDER.iterdir()} == {card.name for card in CARDS}
    wanted = {"card.json", "config.yaml", "play.gif", "weights.safetensors"}
    assert all({path.name for path in (FOLDER / card.name).iterdir()} == wanted for card in CARDS)


@pytest.mark.parametrize("card", CARDS, ids=lambda card: card.name)
def test_the_picture_of_an_agent_is_small(card):
    path = FOLDER / card.name / "play.gif"
    assert path.stat().st_size < LARGEST_PLAY
    with Image.open(path) as picture:
        assert 1 < picture.n_frames <= FRAMES


def test_the_page_shows_the_agents_as_they_are():
    text = (FOLDER.parent / "docs/zoo.md").read_text()
    assert put(text, MARK, gallery(CARDS, "../zoo")) == text, "docs/zoo.md is out of date: run `hdrqn zoo page`"


@pytest.mark.parametrize("card", CARDS, ids=lambda card: card.name)
def test_a_card_names_no_path_of_the_machine_that_trained(card):
    text = (FOLDER / card.name / "card.json").read_text() + (FOLDER / card.name / "config.yaml").read_text()
    assert not any(word.strip("\"'[,").startswith(("/", "~", "C:\\")) for word in text.replace("=", " ").split())


@pytest.mark.slow
@pytest.mark.parametrize("card", CARDS, ids=lambda card: card.name)
def test_the_command_of_a_card_still_has_settings_that_exist(card):
    config = composed(shlex.split(card.command)[2:])
    assert config.seed == card.seed
