import time
from functools import partial

import pytest
import torch
from processes import FORK
from torchrl.envs import EnvCreator, ParallelEnv, SerialEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from hdrqn_torchrl.envs import MultiGoalGridEnv

CORRIDOR = ("######", "#    #", "######")  # cells 7 to 10
STAY, RIGHT = 0, 3  # up is a wall


def corridor_env(num_envs=1, **settings):
    return MultiGoalGridEnv(num_envs, **({"layout": CORRIDOR, "num_obstacles": 1, "num_goals": 2} | settings))


def walk(env, tensordict, *actions):
    """The results of the same actions in every world."""
    for action in actions:
        tensordict = env.step(tensordict.set("action", torch.full((env.num_envs,), action)))["next"]
        yield tensordict
        tensordict = tensordict.exclude("reward", "extrinsic_reward")


def random_rollout(seed=None, **settings):
    env = MultiGoalGridEnv(8, max_steps=10, seed=seed, **settings)
    torch.manual_seed(3)  # of the actions
    return env.rollout(40, break_when_any_done=False)


@pytest.mark.parametrize("num_envs", [1, 4])
@pytest.mark.parametrize(
    "settings", [{}, {"layout": "four_rooms", "num_goals": 3, "view": None, "obstacle": "teleport"}]
)
def test_the_specs_of_the_grid_are_right(num_envs, settings):
    check_env_specs(MultiGoalGridEnv(num_envs, **settings))


def test_the_specs_of_the_grid_are_right_in_a_serial_env():
    check_env_specs(SerialEnv(2, partial(MultiGoalGridEnv, 2)))


def test_the_specs_of_the_grid_are_right_in_a_parallel_env():
    env = ParallelEnv(2, partial(MultiGoalGridEnv, 2, seed=0), mp_start_method=FORK.get_start_method())
    try:
        check_env_specs(env)
    finally:
        env.close()


def test_a_step_reports_what_the_rules_say():
    env = corridor_env()
    start = env.set_world(torch.tensor([7]), torch.tensor([[8, 9, 10]]))
    keys = ("reward", "extrinsic_reward", "hazard", "success", "terminated", "truncated", "done")
    results = [[step[key].item() for key in keys] for step in walk(env, start, RIGHT, RIGHT, RIGHT)]
    assert results == [
        [-1, 0, True, False, False, False, False],
        [1, 1, False, False, False, False, False],
        [1, 1, False, True, True, False, True],
    ]


def test_attained_marks_the_goal_of_this_step_only():
    env = corridor_env()
    start = env.set_world(torch.tensor([7]), torch.tensor([[10, 9, 8]]))
    attained = [step["attained"].tolist() for step in walk(env, start, RIGHT, STAY, RIGHT)]
    assert attained == [[[False, True]], [[False, False]], [[True, False]]]


def test_collecting_all_goals_out_of_order_terminates_without_success():
    env = corridor_env()
    start = env.set_world(torch.tensor([7]), torch.tensor([[10, 9, 8]]))
    *_, last = walk(env, start, RIGHT, RIGHT)
    assert last["terminated"].item()
    assert not last["success"].item()
    assert last["reward"].item() == pytest.approx(0.01)


def test_max_steps_truncates_and_does_not_terminate():
    env = corridor_env(max_steps=3)
    start = env.set_world(torch.tensor([7]), torch.tensor([[10, 9, 8]]))
    flags = [(step["truncated"].item(), step["terminated"].item()) for step in walk(env, start, STAY, STAY, STAY)]
    assert flags == [(False, False), (False, False), (True, False)]


def test_completing_the_task_in_the_last_step_terminates_and_does_not_truncate():
    env = corridor_env(max_steps=2)
    start = env.set_world(torch.tensor([7]), torch.tensor([[10, 8, 9]]))
    *_, last = walk(env, start, RIGHT, RIGHT)
    assert (last["truncated"].item(), last["terminated"].item(), last["done"].item()) == (False, True, True)


def test_a_partial_reset_touches_only_its_rows():
    env = corridor_env(6, max_steps=9, layout=("######", "#    #", "#    #", "######"))
    tensordict = env.reset()
    for _ in range(4):
        tensordict = step_mdp(env.rand_step(tensordict))
    before, state, steps = tensordict.clone(), env.state, env.steps
    mask = torch.tensor([True, False, False, True, False, False])[:, None]
    after = env.reset(tensordict.clone().set("_reset", mask))
    kept = ~mask.squeeze(-1)
    for key in ("observation", "attained", "hazard", "success", "done", "terminated", "truncated"):
        assert (after[key][kept] == before[key][kept]).all(), key
    assert all((new[kept] == old[kept]).all() for new, old in zip(env.state, state, strict=True))
    assert (env.state.agent[~kept] != state.agent[~kept]).any()
    assert env.state.in_order[~kept].all()
    assert (env.steps == torch.where(kept, steps, 0)).all()
    assert (after["observation"] == env.rules.observe(env.state)).all()


def test_a_new_episode_starts_after_the_end_of_one():
    rollout = random_rollout(seed=0)
    length = torch.zeros(8)
    for step in rollout["next"].unbind(-1):
        length += 1
        truncated, terminated = step["truncated"].squeeze(-1), step["terminated"].squeeze(-1)
        assert (truncated == ((length == 10) & ~terminated)).all()
        length[truncated | terminated] = 0


def test_one_seed_repeats_and_two_differ():
    first, again, other = (random_rollout(seed=seed, obstacle="teleport") for seed in (5, 5, 6))
    assert (first == again).all()
    assert (first["observation"] != other["observation"]).any()


def test_set_seed_starts_the_worlds_again():
    env = MultiGoalGridEnv(8, seed=1)
    env.set_seed(4)
    first = env.reset()["observation"]
    assert (env.reset()["observation"] != first).any()
    env.set_seed(4)
    assert (env.reset()["observation"] == first).all()


def test_without_a_seed_the_worlds_follow_torch():
    def worlds(seed):
        torch.manual_seed(seed)
        return MultiGoalGridEnv(8).reset()["observation"]

    assert (worlds(0) == worlds(0)).all()
    assert (worlds(0) != worlds(1)).any()


@pytest.mark.parametrize("settings", [{}, {"layout": "four_rooms", "obstacle": "teleport", "num_goals": 3}], ids=str)
def test_a_second_env_goes_on_from_the_state_of_the_first(settings):
    first, second = (MultiGoalGridEnv(4, max_steps=6, seed=seed, **settings) for seed in (1, 2))
    step = first.reset()
    for _ in range(9):
        _, step = first.step_and_maybe_reset(first.rand_action(step))
    state = first.state_dict()
    second.load_state_dict(state)
    assert (second.steps == first.steps).all() and (first.steps > 0).any()
    actions, rollouts = torch.randint(4, (20, 4)), []
    for env in (first, second):
        at, seen = step.clone(), []
        for action in actions:
            done, at = env.step_and_maybe_reset(at.set("action", action))
            seen.append(done.clone())
        rollouts.append(torch.stack(seen))
    assert (rollouts[0] == rollouts[1]).all() and rollouts[0]["next", "done"].any()
    second.load_state_dict(state)  # still that of the moment when it was taken
    assert (second.steps == state["steps"]).all() and second.steps.max() < 6


def test_the_state_of_another_number_of_worlds_is_refused():
    with pytest.raises(ValueError, match="state_dict must hold 3 worlds, got 4"):
        MultiGoalGridEnv(3).load_state_dict(MultiGoalGridEnv(4).state_dict())


def test_set_world_needs_one_world_for_each_row():
    with pytest.raises(ValueError, match="agent must have one cell for each of the 4 worlds, got 1"):
        corridor_env(4).set_world(torch.tensor([7]), torch.tensor([[8, 9, 10]]))


@pytest.mark.parametrize(
    ("change", "shown"),
    [
        ({"num_envs": 3}, lambda env: env.reset().batch_size),
        ({"layout": "four_rooms"}, lambda env: env.rules.is_wall.sum()),
        ({"num_goals": 3}, lambda env: env.reset()["attained"].shape),
        ({"view": 3}, lambda env: env.reset()["observation"].shape),
        ({"view": None}, lambda env: env.reset()["observation"].shape),
        ({"max_steps": 2}, lambda env: env.rollout(5, break_when_any_done=False)["next", "truncated"].any()),
        ({"obstacle": "teleport"}, lambda env: env.rules.teleport),
        ({"num_obstacles": 5}, lambda env: (env.rules.whole_map(env.state) == 2).sum(dim=(1, 2))[0]),
        ({"layout": "four_rooms", "places": True}, lambda env: len(env.task.subgoals)),
        ({"seed": 1}, lambda env: env.state.agent.sum()),
    ],
    ids=lambda value: str(value) if isinstance(value, dict) else "",  # the same in every process
)
def test_every_argument_changes_something(change, shown):
    usual = {"num_envs": 2, "seed": 0}
    assert shown(MultiGoalGridEnv(**usual)) != shown(MultiGoalGridEnv(**(usual | change)))


def test_all_tensors_are_on_the_given_device():
    env = MultiGoalGridEnv(2, device="cpu")
    assert env.device == torch.device("cpu")
    assert env.rollout(2).device == torch.device("cpu")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_the_grid_runs_on_cuda():
    check_env_specs(MultiGoalGridEnv(2, device="cuda", obstacle="teleport"))


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"num_envs": 0}, "num_envs"),
        ({"max_steps": 0}, "max_steps"),
        ({"view": 2}, "view"),
        ({"num_goals": 0}, "num_goals"),
    ],
)
def test_bad_arguments_are_named(arguments, named):
    with pytest.raises(ValueError, match=named):
        MultiGoalGridEnv(**arguments)


@pytest.mark.slow
def test_one_core_does_a_million_steps_per_second():
    env = MultiGoalGridEnv(1024, seed=0)
    tensordict = env.reset().set("action", torch.randint(4, (1024,)))
    best = float("inf")
    for _ in range(50):
        start = time.process_time()  # what other programs take of the core is not counted
        for _ in range(20):
            env.step(tensordict)
        best = min(best, (time.process_time() - start) / 20)
    assert 1024 / best >= 1_000_000


def test_a_state_without_tensors_as_from_env_creator_restores_nothing():
    env = EnvCreator(lambda: MultiGoalGridEnv(2, max_steps=6, seed=3))()
    fresh = MultiGoalGridEnv(2, max_steps=6, seed=3)
    assert (env.state.objects == fresh.state.objects).all()
    with pytest.raises(KeyError):
        env.load_state_dict({})
