"""Agents that come with the checkout achieve what their cards say."""

import pytest

from hdrqn_torchrl.analysis.zoo import WORLDS, disagreement, score
from hdrqn_torchrl.cli.zoo import FOLDER
from hdrqn_torchrl.runs import load_agent
from hdrqn_torchrl.runs.cards import cards_of

OWN = {"cartpole-positions-drqn": ["examples.own_task.positions.positions"]}
"""Builders that an agent's task names besides the package's."""
NEEDED = (("MiniGrid", "minigrid"), ("BabyAI", "minigrid"), ("montezuma", "ale_py"))
LARGEST = 20_000_000  # bytes of all agents
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


def test_agents_take_little_room_and_are_named_as_their_folders():
    assert sum(path.stat().st_size for path in FOLDER.rglob("*")) < LARGEST
    assert all((FOLDER / card.name / "config.yaml").is_file() for card in CARDS)
