"""A scripted agent of three levels is watched: two places besides the goals of the corridor."""

import io
from dataclasses import replace
from functools import cache, partial

import pytest
import torch
from helpers import AGENT, CORRIDOR, OBJECTS, RIGHT
from rich.console import Console
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv

from hdrqn_torchrl.algorithms import Algorithm, make_hdrqn, make_v3
from hdrqn_torchrl.algorithms.base import copies_of
from hdrqn_torchrl.algorithms.levels import make_levels
from hdrqn_torchrl.algorithms.views import views_of
from hdrqn_torchrl.envs import MultiGoalGridEnv, SubgoalSet
from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.rendering import bar_spans, draw_frame, draw_text, record_episodes
from hdrqn_torchrl.rendering.levels import levels_of
from hdrqn_torchrl.transforms import Critic, SubgoalTransform

PLACES, GOALS = SubgoalSet(names=("cave", "mud"), prefix="places", repeatable=True), SubgoalSet(names=("1", "2"))
VALUES = {"action": [0.0, 0.1, 0.2, 0.5], "places_subgoal": [0.25, 0.75], "subgoal": [1.0, 0.5]}


NAMES = ("all", "bumped", "over")


class Scripted(TensorDictModuleBase):
    """Walks right, to the mud whenever it may choose a place, to the first goal that is left."""

    def __init__(self):
        super().__init__()
        self.in_keys = ["subgoal_mask", "option_init", "active_subgoal", "places_option_init", "places_active_subgoal"]
        self.out_keys, self.writes_values = [*VALUES], False

    def forward(self, td):
        for name, values in VALUES.items():
            values = torch.tensor([values])
            best = values.masked_fill(~td["subgoal_mask"], -1.0) if name == "subgoal" else values
            choice = best.argmax(-1)
            if name != "action":
                prefix = name.removesuffix("subgoal")
                choice = torch.where(td[f"{prefix}option_init"].squeeze(-1), choice, td[f"{prefix}active_subgoal"])
            td.set(name, choice)
            if self.writes_values:
                td.set(f"{name}_value", values)
        return td


def muddy(after):
    """The obstacle lies in the mud."""
    return torch.cat([torch.zeros_like(after["hazard"]), after["hazard"]], -1)


@cache
def frames():
    env = MultiGoalGridEnv(1, layout=CORRIDOR, num_obstacles=1, view=3, max_steps=9)
    env.rules.sample = lambda *_: env.rules.place(AGENT, OBJECTS)
    nearer = SubgoalTransform(
        2, prefix="places", repeatable=True, upper_done_key="option_done", extrinsic_reward_key="intrinsic_reward"
    )
    agent = Algorithm(
        policy=Scripted(),
        learners={},
        explorations={},
        make_transforms=copies_of(Critic(2, muddy, prefix="places"), SubgoalTransform(2), nearer),
        levels=views_of(make_levels(4, [PLACES, GOALS])),
    )
    return record_episodes(agent.transform(env), agent)


def test_every_level_has_its_decision_from_near_to_far():
    assert [[pursuit.level for pursuit in frame.pursuits] for frame in frames()] == [["places", "meta"]] * 4
    assert [[pursuit.name for pursuit in frame.pursuits] for frame in frames()] == [["mud", "1"]] * 2 + [
        ["mud", "2"]
    ] * 2
    assert {frame.action.choice for frame in frames()} == {RIGHT}
    assert {frame.pursuits[0].decision.values for frame in frames()} == {(0.25, 0.75)}
    assert [frame.pursuits[1].decision.allowed for frame in frames()] == [(True, True)] * 2 + [(False, True)] * 2


def test_each_option_lasts_until_it_ends_or_the_one_above_does():
    # The mud is reached by the first step, goal 1 by the second one, goal 2 by the third and last one.
    assert [[pursuit.steps for pursuit in frame.pursuits] for frame in frames()] == [[0, 0], [0, 1], [0, 0], [1, 1]]
    assert [frame.starts_option for frame in frames()] == [True, True, True, False]
    assert "mud reached" in frames()[1].event and "mud reached" not in frames()[2].event


def test_actions_are_paid_by_the_nearest_set():
    assert [frame.score.intrinsic for frame in frames()] == [0.0, 0.0, 0.0, 0.0]  # the hazard and the mud at once
    assert [frame.score.extrinsic for frame in frames()] == [0.0, 0.0, 1.0, 2.0]


def test_pictures_and_text_have_a_line_for_the_level_between():
    frame, spans = frames()[0], bar_spans(frames())
    assert [(level.verb, level.brief) for level in levels_of(frame, spans)] == [
        ("wants", False),
        ("by way of", True),
        ("does", False),
    ]
    assert draw_frame(frame, spans).shape == draw_frame(frames()[3], spans).shape
    assert (draw_frame(frame, spans) != draw_frame(frames()[1], spans)).any()
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(draw_text(frame, spans))
    assert "by way of mud" in console.export_text()


@pytest.mark.parametrize("make", [make_v3, partial(make_hdrqn, version="v1"), partial(make_hdrqn, version="v2")])
def test_an_agent_of_three_levels_shows_the_values_that_each_level_chose_by(make):
    env = MultiGoalGridEnv(1, layout="nine_rooms", view=3, max_steps=12, seed=0)
    agent = make(env, compact_network(8, (8,)), levels=3)
    *played, last = record_episodes(agent.transform(env), agent)
    rooms, goals = env.task.subgoals
    assert len(played) == 12 and last.outcome
    for frame in played:
        assert [pursuit.names for pursuit in frame.pursuits] == [rooms.names, goals.names]
        for decision in (frame.action, *(pursuit.decision for pursuit in frame.pursuits)):
            assert decision.choice == decision.best and len(set(decision.values)) > 1
    assert draw_frame(played[0], bar_spans(played)).any()


def test_subgoals_of_a_critic_that_the_scene_does_not_draw_are_named_as_the_critic_names_them():
    critic = Critic(3, lambda after: torch.cat([after["success"], after["hazard"], after["done"]], -1), names=NAMES)
    env = TransformedEnv(MultiGoalGridEnv(1, view=3, max_steps=20, seed=0), critic)
    agent = make_v3(env, compact_network(8, (8,)), memory_size=8, head_size=8)
    played = record_episodes(agent.transform(env), agent, epsilon=1.0)
    assert {frame.pursuits[-1].names for frame in played} == {NAMES} and {frame.max_steps for frame in played} == {20}
    assert any("bumped reached" in frame.event for frame in played)
    assert draw_frame(played[0], bar_spans(played)).any()


def test_a_task_without_a_scene_shows_what_the_agent_sees():
    env = MultiGoalGridEnv(1, view=3, max_steps=5)
    env.task = replace(env.task, scene=None)
    agent = make_v3(env, compact_network(8, (8,)), memory_size=8, head_size=8)
    frames = record_episodes(agent.transform(env), agent)
    assert all(frame.scene.observation.shape == (3, 3) for frame in frames)
    assert (draw_frame(frames[0]) != draw_frame(frames[-1])).any()


def test_an_agent_that_names_no_levels_is_refused():
    env = MultiGoalGridEnv(1)
    agent = Algorithm(policy=Scripted(), learners={}, explorations={}, make_transforms=copies_of(SubgoalTransform(2)))
    with pytest.raises(ValueError, match="algorithm must name its levels to be watched, got none; "):
        record_episodes(agent.transform(env), agent)
