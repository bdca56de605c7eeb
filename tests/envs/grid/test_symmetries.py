"""The symmetries of grid tasks: a turned world, acted on in turned directions, looks turned and pays the same."""

import pytest
import torch
from helpers import small_env
from torchrl.envs import TransformedEnv

from hdrqn_torchrl.envs import MultiGoalGridEnv, task_of
from hdrqn_torchrl.envs.grid.layouts import map_rows
from hdrqn_torchrl.envs.grid.symmetries import _changes, grid_symmetries
from hdrqn_torchrl.transforms import Critic

RECTANGLE = ["#####", "#   #", "#####"]


@pytest.mark.parametrize(
    ("layout", "number"), [("open", 7), ("four_rooms", 7), (RECTANGLE, 3), (["####", "#  #", "# ##", "####"], 1)]
)
def test_a_map_has_the_symmetries_of_its_walls(layout, number):
    assert len(set(grid_symmetries(layout, 3))) == len(grid_symmetries(layout, 3)) == number


@pytest.mark.parametrize("layout", ["open", "four_rooms"])
def test_changed_worlds_show_and_pay_the_same_after_changed_actions(layout):
    env = MultiGoalGridEnv(64, layout=layout, seed=0)
    env.reset()
    start, rows = env.state, map_rows(layout)
    cells = torch.arange(len(rows) * len(rows[0])).view(len(rows), -1)
    actions = torch.randint(4, (20, 64), generator=torch.Generator().manual_seed(0))
    plain = play(env, start.agent, start.objects, actions)
    assert plain["reward"].ne(0).any()
    for change, symmetry in zip(_changes(), env.task.symmetries, strict=True):
        moved = change(cells).flatten().argsort()  # where each cell lies in the changed map
        turned = play(env, moved[start.agent], moved[start.objects], torch.tensor(symmetry.actions)[actions])
        for key in ("reward", "attained", "terminated"):
            assert torch.equal(plain[key], turned[key])
        seen = plain["observation"].flatten(2)[..., list(symmetry.places)]
        assert torch.equal(seen, turned["observation"].flatten(2))


def play(env, agent, objects, actions):
    """What each step showed and paid, whether or not episodes had ended before it."""
    step, steps = env.set_world(agent, objects), []
    for chosen in actions:
        step = env.step(step.set("action", chosen))["next"]
        steps.append(step.select("observation", "reward", "attained", "terminated"))
        step = step.exclude("reward")
    return torch.stack(steps)


def test_nothing_is_known_of_symmetries_behind_a_critic_which_may_look_at_places():
    critic = Critic(2, lambda after: after["observation"][..., 0, :2] == 1)
    assert task_of(TransformedEnv(small_env(2), critic)).symmetries == ()


def test_places_have_no_symmetries_as_subgoals_would_change_too():
    assert task_of(MultiGoalGridEnv(2, layout="four_rooms", places=True)).symmetries == ()
