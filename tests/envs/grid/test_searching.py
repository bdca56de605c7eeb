"""The player that must find out where it is. What it shares with the memory player is tested in test_scripted.py."""

from types import SimpleNamespace

import pytest
import torch
from torchrl.envs.utils import step_mdp

from hdrqn_torchrl.envs import EgocentricSearch, MultiGoalGridEnv, PerfectMemorySearch, play_episodes
from hdrqn_torchrl.envs.grid import searching
from hdrqn_torchrl.envs.grid.cells import WALL

CORRIDOR = ("#" * 11, "#" + " " * 9 + "#", "#" * 11)  # free cells 12 to 20


def paths(env, player, steps=30):
    """Cells that the agents stand on after each step of their first episodes, -1 after its end: ``[N, steps]``."""
    tensordict, cells, ended = env.reset(), [], torch.zeros(env.num_envs, dtype=torch.bool)
    for _ in range(steps):
        tensordict = step_mdp(env.step(player(tensordict)))
        cells.append(env.state.agent.where(~ended, -1))
        ended |= tensordict["done"].squeeze(-1)
    return torch.stack(cells, -1)


def walk(env, agent, objects, steps):
    """The same from a chosen world, as a list."""
    tensordict, player, cells = env.set_world(torch.tensor([agent]), torch.tensor([objects])), EgocentricSearch(env), []
    for _ in range(steps):
        tensordict = step_mdp(env.step(player(tensordict)))
        cells.append(env.state.agent.item())
    return cells


def corridor(view=3):
    return MultiGoalGridEnv(1, layout=CORRIDOR, num_obstacles=0, num_goals=1, view=view)


def test_the_egocentric_player_walks_the_wrong_way_where_it_cannot_know_better():
    there, back = list(range(13, 11, -1)), list(range(13, 21))
    assert walk(corridor(), 14, [20], 10) == there + back  # no end of the corridor in view: it tries the left first


def test_an_end_in_view_shows_the_egocentric_player_where_the_room_is():
    assert walk(corridor(), 19, [12], 7) == list(range(18, 11, -1))
    assert walk(corridor(), 12, [20], 8) == list(range(13, 21))


def test_the_egocentric_player_knows_the_far_end_once_it_has_seen_the_near_one():
    """On cell 19 all has been seen; a player that does not know the corridor's length would look for its end."""
    env = MultiGoalGridEnv(1, layout=CORRIDOR, num_obstacles=1, num_goals=1, view=3)
    assert walk(env, 12, [20, env.rules.nowhere], 9)[6] == 19
    floor = EgocentricSearch(env)
    floor(env.set_world(torch.tensor([12]), torch.tensor([[19, 20]])))
    known = floor._chance_of_floor()[0]
    assert known.sum() == 9 and known.unique().tolist() == [0.0, 1.0]


def test_start_cells_that_fit_are_equally_likely():
    env = corridor()
    player = EgocentricSearch(env)
    player(env.set_world(torch.tensor([16]), torch.tensor([[20]])))
    middle = player._chance_of_floor().view(1, 17)[0]  # from 8 cells to the left of the start to 8 to the right
    # No end in view: it starts on one of the 7 inner cells, 1 to 7 cells away from either end.
    expected = [0, *(sevenths / 7 for sevenths in (1, 2, 3, 4, 5, 6, 7, 7, 7, 6, 5, 4, 3, 2, 1)), 0]
    assert torch.allclose(middle, torch.tensor(expected))


def test_the_true_start_always_fits():
    for task in ({"view": 3}, {"layout": "four_rooms", "view": 3}, {"view": 1, "obstacle": "teleport"}):
        env = MultiGoalGridEnv(50, seed=0, **task)
        player, tensordict = EgocentricSearch(env), env.reset()
        row, column = env.state.agent // 11, env.state.agent % 11
        cells = torch.arange(17 * 17)
        rows, columns = row[:, None] + cells // 17 - 8, column[:, None] + cells % 17 - 8
        inside = (rows >= 0) & (rows < 11) & (columns >= 0) & (columns < 11)
        is_floor = inside & ~env.rules.is_wall[(rows * 11 + columns).where(inside, 0)]
        for _ in range(15):
            tensordict = step_mdp(env.step(player(tensordict)))
            assert (player._chance_of_floor()[is_floor] > 0).all()


@pytest.mark.parametrize("view", [1, 3, 5])
def test_the_egocentric_player_does_not_use_its_position(view):
    """The player sees the cells of the world renamed at random: only whether a step moved it comes through."""
    settings = {"num_goals": 3, "view": view, "layout": "four_rooms", "seed": 0}
    env, other = MultiGoalGridEnv(40, **settings), MultiGoalGridEnv(40, **settings)
    names = torch.stack([torch.randperm(env.rules.nowhere) for _ in range(40)])
    shown = SimpleNamespace(rules=env.rules, num_envs=40, device=env.device)
    player = EgocentricSearch(shown)

    def blinded(tensordict):
        shown.steps, shown.state = env.steps, SimpleNamespace(agent=names.gather(1, env.state.agent[:, None])[:, 0])
        return player(tensordict)

    assert (paths(env, blinded) == paths(other, EgocentricSearch(other))).all()


def test_the_egocentric_player_acts_alike_where_the_windows_are_alike():
    env = MultiGoalGridEnv(2, num_obstacles=1, num_goals=1, view=3)
    offset = 3 * 11 + 2
    start = torch.tensor([3 * 11 + 4, 3 * 11 + 4 + offset])
    objects = torch.tensor([[2 * 11 + 4, 9 * 11 + 9], [2 * 11 + 4 + offset, 1 * 11 + 1]])
    tensordict, player = env.set_world(start, objects), EgocentricSearch(env)
    same = 0
    while (tensordict["observation"][0] == tensordict["observation"][1]).all():
        same += 1
        assert env.state.agent[1] == env.state.agent[0] + offset
        tensordict = step_mdp(env.step(player(tensordict)))
    assert same > 2


@pytest.mark.parametrize("task", [{"view": None, "num_goals": 3}, {"view": None, "layout": "four_rooms"}], ids=str)
def test_with_the_whole_map_in_view_the_egocentric_player_equals_the_memory_player(task):
    env, other = (MultiGoalGridEnv(50, seed=1, **task) for _ in range(2))
    assert (paths(env, EgocentricSearch(env)) == paths(other, PerfectMemorySearch(other))).all()


def test_where_the_first_window_shows_the_position_the_egocentric_player_equals_the_memory_player(monkeypatch):
    monkeypatch.setattr(searching, "_HASTE_IN_DOUBT", searching._HASTE)
    env, other = (MultiGoalGridEnv(50, seed=1, layout="four_rooms", view=5) for _ in range(2))
    assert (paths(env, EgocentricSearch(env)) == paths(other, PerfectMemorySearch(other))).all()


def test_a_stopped_step_shows_a_wall_to_a_player_that_sees_only_its_own_cell():
    env = corridor(view=1)
    player = EgocentricSearch(env)
    tensordict = env.set_world(torch.tensor([12]), torch.tensor([[20]]))
    tensordict = step_mdp(env.step(player(tensordict).set("action", torch.tensor([2]))))
    player._last = torch.tensor([2]), player._last[1]
    player(tensordict)
    assert player._memory.codes[0, player._start - 1] == WALL
    assert player._place.item() == player._start


def test_the_egocentric_player_finds_almost_all_goals_somewhat_later_than_the_memory_player():
    env, other = (MultiGoalGridEnv(300, seed=1) for _ in range(2))
    lost, told = play_episodes(env, EgocentricSearch(env)), play_episodes(other, PerfectMemorySearch(other))
    assert lost["success_rate"] >= 0.99
    assert told["steps_mean"] + 0.3 < lost["steps_mean"] < told["steps_mean"] + 2.0
