"""Rooms and doors: their number, when they are entered, and where goals are placed."""

import random

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from hdrqn_torchrl.envs import MultiGoalGridEnv, task_of
from hdrqn_torchrl.envs.grid.layouts import LAYOUTS
from hdrqn_torchrl.envs.grid.places import find_places
from hdrqn_torchrl.envs.grid.rules import GridRules

TWO_ROOMS = ("#######", "#  #  #", "#     #", "#######")
NINE_DOORS = ("1-2", "2-3", "1-4", "2-5", "3-6", "5-6", "4-5", "4-7", "5-8", "6-9", "7-8", "8-9")
MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))


class Walker:
    """One agent in nine rooms, followed with loops: the place of a cell is found from its walls, not from a table."""

    def __init__(self, row, column):
        self.rows, self.at = LAYOUTS["nine_rooms"], (row, column)

    def place(self):
        row, column = self.at
        bands = [sum(line > border for border in (5, 11)) for line in self.at]
        if row in (5, 11):
            above = 3 * bands[0] + bands[1] + 1
            return f"door {above}-{above + 3}"
        if column in (5, 11):
            left = 3 * bands[0] + bands[1] + 1
            return f"door {left}-{left + 1}"
        return f"room {3 * bands[0] + bands[1] + 1}"

    def move(self, action):
        """The place entered, if one was."""
        before, (row, column), (down, right) = self.place(), self.at, MOVES[action]
        if self.rows[row + down][column + right] != "#":
            self.at = row + down, column + right
        return self.place() if self.place() != before else None


def test_nine_rooms_have_twelve_doors_between_neighbours():
    places = find_places(LAYOUTS["nine_rooms"])
    assert places.names == (*(f"room {room}" for room in range(1, 10)), *(f"door {pair}" for pair in NINE_DOORS))
    assert places.num_rooms == 9
    sizes = torch.bincount(places.of_cell)
    assert sizes[:9].tolist() == [16, 20, 16, 20, 25, 20, 16, 20, 16] and (sizes[9:-1] == 1).all()


def test_every_room_of_nine_can_be_reached():
    rules = GridRules("nine_rooms")
    reached = torch.zeros(rules.nowhere, dtype=torch.bool)
    reached[rules.free_cells[0]] = True
    for _ in range(rules.nowhere):
        reached[rules.moves[reached]] = True
    assert reached[rules.free_cells].all()


def test_a_place_is_attained_by_the_step_that_enters_it_and_is_not_available_while_one_is_there():
    env = MultiGoalGridEnv(6, layout="nine_rooms", max_steps=10_000, num_obstacles=0, num_goals=1, seed=0)
    tensordict, entered = env.reset(), set()
    env.state = env.state._replace(objects=torch.full((6, 1), env.rules.nowhere))  # without a goal there is no end
    names, chance = env.rules.places.names, random.Random(0)
    walkers = [Walker(*divmod(cell, env.rules.width)) for cell in env.state.agent.tolist()]
    assert not tensordict["rooms_attained"].any()
    for _ in range(3000):
        actions = [chance.randrange(4) for _ in walkers]
        expected = [walker.move(action) for walker, action in zip(walkers, actions, strict=True)]
        after = env.step(tensordict.set("action", torch.tensor(actions)))["next"]
        attained = [[name == place for name in names] for place in expected]
        assert after["rooms_attained"][:, :-1].tolist() == attained
        assert after["rooms_available"][:, :-1].tolist() == [
            [name != walker.place() for name in names] for walker in walkers
        ]
        entered |= set(expected)
        tensordict = after.exclude("reward", "extrinsic_reward")
    assert entered == {*names, None}


def test_goals_are_nearer_subgoals_as_well_as_a_place_alone_does_not_lead_to_one():
    env = MultiGoalGridEnv(64, layout="nine_rooms", seed=0)
    step = env.rollout(150, break_when_any_done=False)
    assert torch.equal(step["next", "rooms_attained"][..., 21:], step["next", "attained"])
    taken = step["next", "attained"].any(1)
    assert taken.any() and env.task.subgoals[0].names[21:] == ("goal 1", "goal 2")
    after = step["next", "rooms_available"][..., 21:]
    assert not (after & step["next", "attained"]).any(), "what was just taken is not worth choosing"
    gone = ~step["rooms_available"][..., 21:]
    assert not (gone & step["next", "attained"]).any() and gone.any()


def test_after_a_reset_all_places_but_the_start_are_available():
    env = MultiGoalGridEnv(50, layout="nine_rooms", seed=0)
    for begin in (env.reset, lambda: env.set_world(env.state.agent.flip(0), env.state.objects.flip(0))):
        start = begin()
        expected = env.rules.places.of_cell[env.state.agent][:, None] != torch.arange(21)
        assert (start["rooms_available"][:, :21] == expected).all() and start["rooms_available"][:, 21:].all()


def test_goals_lie_in_other_rooms_than_the_start_and_nothing_stands_in_a_door():
    rules = GridRules("nine_rooms", num_goals=2, num_obstacles=2)
    state = rules.sample(4000, torch.Generator().manual_seed(0))
    agent, objects = rules.places.of_cell[state.agent], rules.places.of_cell[state.objects]
    assert (objects[:, 2:] != agent[:, None]).all()
    assert (objects < 9).all() and (agent < 9).all()
    everything = torch.cat([state.agent[:, None], state.objects], -1).sort(-1).values
    assert (everything[:, 1:] != everything[:, :-1]).all()
    shares = torch.bincount(state.agent, minlength=289)[rules.places.of_cell < 9] / 4000
    assert shares.max() < 3 / 169 and shares.min() > 0  # of 169 cells
    rest = state.objects[:, 0][agent != objects[:, 0]]
    assert len(rest) / 4000 == pytest.approx(1 - 19.2 / 169, abs=0.02)  # obstacles stand in the agent's room, too


def test_other_layouts_have_places_only_on_request_and_the_same_worlds():
    plain, rooms = (MultiGoalGridEnv(4, layout="four_rooms", seed=0, places=places) for places in (None, True))
    assert "rooms_attained" not in plain.observation_spec and len(task_of(plain).subgoals) == 1
    assert task_of(rooms).subgoals[0].names[4:] == ("door 1-2", "door 1-3", "door 2-4", "door 3-4", "goal 1", "goal 2")
    assert (plain.rollout(5)["observation"][:, 0] == rooms.rollout(5)["observation"][:, 0]).all()


def test_nine_rooms_without_places_are_the_same_worlds_with_one_set_of_subgoals():
    with_places, without = (MultiGoalGridEnv(4, layout="nine_rooms", seed=0, places=places) for places in (None, False))
    assert (with_places.reset()["observation"] == without.reset()["observation"]).all()
    assert [subgoals.names for subgoals in without.task.subgoals] == [("goal 1", "goal 2")]
    check_env_specs(with_places)


def test_the_two_sets_of_subgoals_are_named_from_near_to_far():
    near, far = task_of(MultiGoalGridEnv(2, layout="nine_rooms", num_goals=3)).subgoals
    assert (near.prefix, near.repeatable, len(near)) == ("rooms", True, 24)
    assert (far.prefix, far.repeatable, far.names) == ("", False, ("goal 1", "goal 2", "goal 3"))


@pytest.mark.parametrize("rows", [["###", "# #", "###"], ["#######", "#     #", "#######"], LAYOUTS["open"]])
def test_maps_without_doors_between_rooms_have_no_places(rows):
    with pytest.raises(ValueError, match="layout must have doors of one cell, each between two rooms"):
        find_places(rows)
    MultiGoalGridEnv(1, layout=TWO_ROOMS, places=True)


def test_more_objects_than_fit_outside_the_largest_room_are_refused():
    with pytest.raises(ValueError, match="num_goals and num_obstacles must together be <= 144"):
        GridRules("nine_rooms", num_goals=50, num_obstacles=95)
