import random

import pytest
import torch

from hdrqn_torchrl.envs.grid.cells import FIRST_GOAL, FLOOR, OBSTACLE, WALL
from hdrqn_torchrl.envs.grid.layouts import LAYOUTS
from hdrqn_torchrl.envs.grid.rules import ACTIONS, GridRules

UP, DOWN, LEFT, RIGHT = range(4)
SMALL = ("#####", "#   #", "# # #", "#   #", "#####")  # eight free cells: goals are met often, in every order
UNWALLED = ("    ", " #  ", "    ")  # neither square nor closed by a border
CORRIDOR = ("########", "#      #", "########")


class PlainWorld:
    """The rules once more, written from the paper for one world, with sets and loops."""

    def __init__(self, rows, agent, obstacles, goals):
        self.free = {(r, c) for r, row in enumerate(rows) for c, cell in enumerate(row) if cell != "#"}
        self.agent, self.obstacles, self.goals = agent, list(obstacles), dict(enumerate(goals))
        self.num_goals, self.collected = len(goals), []

    def step(self, action):
        down, right = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1)}[ACTIONS[action]]
        target = (self.agent[0] + down, self.agent[1] + right)
        if target in self.free:
            self.agent = target
        extrinsic, attained = 0.0, [False] * self.num_goals
        for goal, place in list(self.goals.items()):
            if place == self.agent:
                del self.goals[goal]
                self.collected.append(goal)
                attained[goal] = True
                extrinsic = 1.0 if self.in_order() else 0.01
        hazard = self.agent in self.obstacles
        finished = not self.goals
        return {
            "reward": extrinsic - hazard,
            "extrinsic_reward": extrinsic,
            "hazard": hazard,
            "attained": attained,
            "all_collected": finished,
            "success": finished and any(attained) and self.in_order(),
        }

    def in_order(self):
        return self.collected == sorted(self.collected) == list(range(len(self.collected)))

    def code(self, place):
        if place in self.obstacles:
            return OBSTACLE
        for goal, goal_place in self.goals.items():
            if place == goal_place:
                return FIRST_GOAL + goal
        return FLOOR if place in self.free else WALL

    def window(self, size):
        (row, column), radius = self.agent, size // 2
        around = range(-radius, radius + 1)
        return [[self.code((row + down, column + right)) for right in around] for down in around]


def plain_worlds(rules, rows, state):
    for agent, objects in zip(state.agent.tolist(), state.objects.tolist(), strict=True):
        places = [divmod(cell, rules.width) for cell in (agent, *objects)]
        yield PlainWorld(rows, places[0], places[1 : 1 + rules.num_obstacles], places[1 + rules.num_obstacles :])


def place(rules, agent, *objects):
    """One world from (row, column) pairs; ``None`` leaves an object out."""
    cells = [rules.nowhere if spot is None else spot[0] * rules.width + spot[1] for spot in objects]
    return rules.place(torch.tensor([agent[0] * rules.width + agent[1]]), torch.tensor([cells]))


def play(rules, state, actions):
    """Rewards of a sequence of actions in one world, and the last events and state."""
    rewards, events = [], None
    for action in actions:
        state, events = rules.step(state, torch.tensor([action]))
        rewards.append(round(events.reward.item(), 6))
    return rewards, events, state


@pytest.mark.parametrize("obstacle", ["stay", "teleport"])
@pytest.mark.parametrize(("num_goals", "view"), [(1, None), (2, 3), (3, 5)])
@pytest.mark.parametrize("layout", ["open", "four_rooms", SMALL, UNWALLED], ids=["open", "rooms", "small", "unwalled"])
def test_the_rules_agree_with_a_plain_reference(layout, num_goals, view, obstacle):
    rules = GridRules(layout, num_goals=num_goals, view=view, obstacle=obstacle)
    rows, draw, generator = LAYOUTS.get(layout, layout), random.Random(1), torch.Generator().manual_seed(1)
    for _ in range(3):
        state = rules.sample(8, generator)
        worlds = list(plain_worlds(rules, rows, state))
        for _ in range(30):
            actions = [draw.randrange(4) for _ in worlds]
            state, events = rules.step(state, torch.tensor(actions), generator)
            windows = rules.observe(state).tolist()
            for index, (world, action) in enumerate(zip(worlds, actions, strict=True)):
                expected = world.step(action)
                if obstacle == "teleport" and expected["hazard"]:
                    adopt_moved_obstacle(world, rules, state.objects[index].tolist())
                for name, value in expected.items():
                    assert getattr(events, name)[index].tolist() == pytest.approx(value), name
                assert windows[index] == world.window(rules.view)


def adopt_moved_obstacle(world, rules, objects):
    """The new place is random: check that it is free, then go on from there."""
    hit = world.obstacles.index(world.agent)
    moved = divmod(objects[hit], rules.width)
    assert moved in world.free - {world.agent, *world.obstacles, *world.goals.values()}
    world.obstacles[hit] = moved


def test_goals_in_order_pay_one_each():
    rules = GridRules(CORRIDOR, num_goals=3, num_obstacles=0)
    rewards, events, state = play(rules, place(rules, (1, 1), (1, 2), (1, 3), (1, 5)), [RIGHT] * 4)
    assert rewards == [1, 1, 0, 1]
    assert events.success.item()
    assert events.all_collected.item()
    assert (state.objects == rules.nowhere).all()


def test_every_goal_after_one_out_of_order_pays_a_hundredth():
    rules = GridRules(CORRIDOR, num_goals=3, num_obstacles=0)
    rewards, events, _ = play(rules, place(rules, (1, 1), (1, 3), (1, 2), (1, 4)), [RIGHT] * 3)
    assert rewards == [0.01, 0.01, 0.01]
    assert events.all_collected.item()
    assert not events.success.item()


def test_an_obstacle_costs_one_for_every_step_spent_on_it():
    rules = GridRules(CORRIDOR, num_goals=1, num_obstacles=1)
    rewards, events, state = play(rules, place(rules, (1, 1), (1, 2), (1, 4)), [RIGHT, UP, LEFT, RIGHT])
    assert rewards == [-1, -1, 0, -1]
    assert events.hazard.item()
    assert events.extrinsic_reward.item() == 0
    assert rules.observe(state)[0, 2, 2] == OBSTACLE  # it stands on it


def test_walls_and_the_map_border_stop_the_move():
    for layout, corner in ((SMALL, (1, 1)), (UNWALLED, (0, 0))):
        rules = GridRules(layout, num_goals=1, num_obstacles=0)
        start = place(rules, corner, (2, 3))
        for action in (UP, LEFT):
            assert play(rules, start, [action])[2].agent == start.agent
        for action in (DOWN, RIGHT):
            assert play(rules, start, [action])[2].agent != start.agent


def test_a_reached_goal_leaves_the_map_and_pays_once():
    rules = GridRules(CORRIDOR, num_goals=2, num_obstacles=0)
    start = place(rules, (1, 1), (1, 2), (1, 6))
    assert FIRST_GOAL in rules.whole_map(start)
    rewards, _, state = play(rules, start, [RIGHT, LEFT, RIGHT])
    assert rewards == [1, 0, 0]
    assert FIRST_GOAL not in rules.whole_map(state)


def test_a_hit_obstacle_moves_uniformly_over_the_free_cells():
    rules, worlds = GridRules(SMALL, num_goals=1, obstacle="teleport"), 4000
    start = place(rules, (1, 1), (1, 2), (3, 3), (3, 1))
    start = type(start)(*(field.expand(worlds, *field.shape[1:]) for field in start))
    state, events = rules.step(start, torch.full((worlds,), RIGHT))
    assert events.hazard.all()
    assert (state.objects[:, 1:] == start.objects[:, 1:]).all()
    cells, counts = state.objects[:, 0].unique(return_counts=True)
    expected = {1 * 5 + 1, 1 * 5 + 3, 2 * 5 + 1, 2 * 5 + 3, 3 * 5 + 2}  # not the agent's cell, not an object's
    assert set(cells.tolist()) == expected
    assert counts.min() > 0.85 * worlds / 5


def test_the_window_is_centred_on_the_agent_and_shows_walls_outside_the_map():
    rules = GridRules(UNWALLED, num_goals=1, num_obstacles=1, view=3)
    window = rules.observe(place(rules, (0, 0), (0, 1), (1, 0)))[0].tolist()
    assert window == [[WALL] * 3, [WALL, FLOOR, OBSTACLE], [WALL, FIRST_GOAL, WALL]]


@pytest.mark.parametrize("layout", ["open", "four_rooms", UNWALLED])
def test_without_a_view_every_object_is_seen_from_everywhere(layout):
    rules = GridRules(layout, view=None)
    assert rules.view == {"open": 19, "four_rooms": 19, UNWALLED: 9}[layout]  # the walls around are seen as well
    windows = rules.observe(rules.sample(500))
    for code in (FIRST_GOAL, FIRST_GOAL + 1):
        assert ((windows == code).flatten(1).sum(-1) == 1).all()
    assert ((windows == OBSTACLE).flatten(1).sum(-1) == 2).all()


def test_window_cells_name_what_the_window_shows():
    rules = GridRules("four_rooms", view=5)
    state = rules.sample(50)
    padded = torch.nn.functional.pad(rules.whole_map(state).flatten(1), (0, 1), value=WALL)
    shown = padded.gather(1, rules.window_cells[state.agent])
    assert (shown == rules.observe(state).flatten(1)).all()


@pytest.mark.parametrize("layout", ["open", "four_rooms"])
def test_worlds_are_uniform_over_distinct_free_cells(layout):
    rules, worlds = GridRules(layout), 20_000
    state = rules.sample(worlds, torch.Generator().manual_seed(0))
    placed = torch.cat([state.agent[:, None], state.objects], -1)
    ordered = placed.sort(-1).values
    assert (ordered[:, 1:] > ordered[:, :-1]).all()
    free = len(rules.free_cells)
    assert free == {"open": 81, "four_rooms": 68}[layout]
    for column in placed.unbind(-1):
        counts = torch.bincount(column, minlength=rules.nowhere)
        assert counts[rules.is_wall].sum() == 0
        expected = worlds / free
        chi_square = ((counts[rules.free_cells] - expected) ** 2 / expected).sum()
        assert abs(chi_square - (free - 1)) < 5 * (2 * (free - 1)) ** 0.5
    offset = (placed[:, 1] - placed[:, 0]).float()  # independent of each other, apart from being distinct
    assert abs(offset.mean()) < 1.0


def test_all_tables_and_results_live_on_the_device():
    rules = GridRules("four_rooms", device="meta")  # refuses to mix with tensors on the CPU
    state, events = rules.step(rules.sample(3), torch.zeros(3, dtype=torch.int64, device="meta"))
    results = [*state, *events, rules.observe(state), rules.whole_map(state)]
    assert {tensor.device.type for tensor in results} == {"meta"}


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"layout": "maze"}, "layout"),
        ({"layout": ()}, "layout"),
        ({"layout": ("   ", "  ")}, "layout"),
        ({"layout": ("    ",)}, "layout"),
        ({"num_goals": 0}, "num_goals"),
        ({"num_goals": 79}, "num_goals"),
        ({"num_obstacles": -1}, "num_obstacles"),
        ({"view": 4}, "view"),
        ({"view": 0}, "view"),
        ({"view": -3}, "view"),
        ({"obstacle": "bounce"}, "obstacle"),
        ({"layout": ("     ",), "obstacle": "teleport"}, "layout"),
    ],
)
def test_bad_arguments_are_named(arguments, named):
    with pytest.raises(ValueError, match=named):
        GridRules(**arguments)


def test_bad_worlds_are_named():
    rules = GridRules(CORRIDOR, num_goals=1, num_obstacles=1)
    with pytest.raises(ValueError, match=r"agent must stand on free cells, got \[0\]"):
        place(rules, (0, 0), (1, 2), (1, 3))
    with pytest.raises(ValueError, match="objects must stand on free cells"):
        place(rules, (1, 1), (1, 2), (2, 3))
    with pytest.raises(ValueError, match="distinct cells"):
        place(rules, (1, 1), (1, 2), (1, 1))
    with pytest.raises(ValueError, match=r"objects \[N, 2\]"):
        place(rules, (1, 1), (1, 2))
    place(rules, (1, 1), None, None)  # two objects that are left out share no cell
