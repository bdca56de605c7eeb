"""Events in the changes that movements do not explain."""

import pytest
import torch
from helpers import small_env
from torchrl.data import Unbounded

from hdrqn_torchrl.discovery import ChangeDetector, make_change_detector
from hdrqn_torchrl.discovery.layout import Layout
from hdrqn_torchrl.envs import MultiGoalGridEnv


def random_play(env, steps, seed=0):
    """Batches of random play, ``[N, T]``."""
    generator = torch.Generator().manual_seed(seed)
    state, rows = env.reset(), []
    for _ in range(steps):
        state["action"] = torch.randint(env.action_spec.space.n, env.batch_size, generator=generator)
        step, state = env.step_and_maybe_reset(state)
        rows.append(step)
    return torch.stack(rows, 1)


def taught(env, frames=2_000, **settings):
    """A detector that is ready, and what followed."""
    detector = make_change_detector(env.observation_spec["observation"], 4, warmup_frames=frames, **settings)
    play = random_play(env, 2 * frames // env.batch_size[0])
    for batch in play.split(10, 1):
        detector.observe(batch["observation"], batch["action"], batch["next", "observation"])
    return detector, play


def tokens_of(detector, play):
    return detector(play["observation"], play["action"], play["next", "observation"])


@pytest.fixture(scope="module")
def room():
    return taught(small_env(32, num_obstacles=0, max_steps=16))


@pytest.mark.parametrize("obstacle", ["stay", "teleport"])
def test_goals_that_are_taken_are_the_only_events_beside_obstacles_that_jump(obstacle):
    env = MultiGoalGridEnv(64, num_goals=2, obstacle=obstacle, seed=0)
    detector, play = taught(env, 4_000)
    tokens = tokens_of(detector, play)
    named = {detector.name(token): token for token in tokens[tokens > 0].unique().tolist()}
    for goal, name in enumerate(("(2, 2): 3 -> 0", "(2, 2): 4 -> 0")):
        assert torch.equal((tokens == named[name]).any(-1), play["next", "attained"][..., goal])
    others = [name for name in named if " 2" not in name.partition(":")[2]]
    assert set(others) == {"(2, 2): 3 -> 0", "(2, 2): 4 -> 0"}
    assert obstacle == "teleport" or set(named) == set(others)


def test_a_room_whose_centre_never_changes_shows_its_goals_all_the_same(room):
    detector, play = room
    tokens = tokens_of(detector, play)
    assert torch.equal((tokens > 0).any(-1), play["next", "attained"].any(-1))
    assert detector.at_agent(int(tokens.max()))


def test_there_are_no_events_until_it_is_ready_and_a_token_then_means_the_same_for_ever(room):
    detector, play = room
    state = {name: value.clone() for name, value in detector.state_dict().items()}
    detector.observe(play["observation"], play["action"], play["next", "observation"])
    assert all(torch.equal(value, detector.state_dict()[name]) for name, value in state.items())
    fresh = ChangeDetector((5,) * 9, 4, num_dims=2)
    assert not fresh.ready
    assert not tokens_of(fresh, play).any()
    fresh.load_state_dict(state)
    assert torch.equal(tokens_of(fresh, play), tokens_of(detector, play))


def test_tokens_of_a_step_do_not_depend_on_the_others(room):
    detector, play = room
    alone = torch.stack([tokens_of(detector, play[world]) for world in range(len(play))])
    assert torch.equal(alone, tokens_of(detector, play))


def test_the_last_token_says_that_a_step_was_rewarded():
    detector = ChangeDetector((), 2, num_tokens=2)
    before, action = torch.zeros(3, 4), torch.tensor([0, 1, 0])
    reward = torch.tensor([[0.0], [1.0], [-1.0]])
    assert detector(before, action, before, reward).tolist() == [[0, 0], [0, detector.layout.reward_token], [0, 0]]
    assert detector.name(detector.layout.reward_token) == "reward"


def test_observations_without_codes_have_no_events_but_rewards_and_a_warning_says_so():
    with pytest.warns(UserWarning, match=r"shape \[4\] are no cells of codes.*only event is a reward"):
        detector = make_change_detector(Unbounded(shape=(2, 4)), 2, warmup_frames=10)
    steps = torch.zeros(2, 10, 4)
    detector.observe(steps, torch.zeros(2, 10).long(), steps)
    detector.observe(steps, torch.zeros(2, 10).long(), steps)
    assert detector.ready
    assert not detector(steps, torch.zeros(2, 10).long(), steps).any()


@pytest.mark.parametrize(
    ("codes", "layout"),
    [
        ((5,) * 25, Layout(25, (5,))),
        ((11, 6, 4) * 49 + (4, 30, 30), Layout(49, (11, 6, 4))),
        ((4, 2), Layout(0, ())),
    ],
)
def test_cells_and_planes_are_found_in_numbers_of_codes(codes, layout):
    assert Layout.of(codes) == layout


def test_a_token_that_does_not_exist_has_no_name():
    detector = ChangeDetector((2,) * 4, 2)
    with pytest.raises(ValueError, match=r"token must lie in \[1, 17\], got 18"):
        detector.name(18)
