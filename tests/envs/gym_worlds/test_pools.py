"""Worlds of EnvPool: of a stand-in for it, and of the real one where it is installed."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gym_toys import Counter
from gymnasium import spaces

from hdrqn_torchrl.envs import make_gym
from hdrqn_torchrl.envs.check_choices import random_actions

STEPS = 40


def played(env, steps=STEPS):
    """A rollout with known actions, among those that can be chosen."""
    torch.manual_seed(0)
    return env.rollout(steps, lambda tensordict: random_actions(env, tensordict), break_when_any_done=False)


class StandIn:
    """Counters whose masks lie where an environment of EnvPool's has them."""

    def __init__(self, part, name, num_envs):
        self.part, self.name = part, name
        self.worlds = [Counter(masked=True) for _ in range(num_envs)]

    def reset(self, chosen):
        return self._told([self.worlds[index].reset(seed=int(index)) for index in chosen])

    def step(self, actions):
        stepped = [world.step(action) for world, action in zip(self.worlds, actions, strict=True)]
        shown, info = self._told([(observation, told) for observation, *_, told in stepped])
        return shown, *(np.array(part) for part in list(zip(*stepped, strict=True))[1:4]), info

    def _told(self, pairs):
        mask = np.stack([told["action_mask"] for _, told in pairs])
        shown = {"count": np.stack([observation for observation, _ in pairs])}
        info = {"env_id": np.arange(len(pairs))}
        {"obs": shown, "info": info}[self.part][self.name] = mask
        return shown, info


@pytest.fixture
def install(monkeypatch):
    """Puts the stand-in where EnvPool is looked for."""

    def installed(part, name, players=1):
        space = {"count": Counter.observation_space}
        if part == "obs":
            space[name] = spaces.Box(0, 1, (2,), np.bool_)
        spec = SimpleNamespace(
            gymnasium_observation_space=spaces.Dict(space),
            gymnasium_action_space=Counter.action_space,
            state_array_spec={f"{part}:{name}": None, "info:env_id": None},
            config=SimpleNamespace(max_episode_steps=2**31 - 1, max_num_players=players),
        )
        module = SimpleNamespace(
            list_all_envs=lambda: ["Counter-v0"],
            make_spec=lambda id, **options: spec,
            make=lambda id, *, env_type, num_envs, seed: StandIn(part, name, num_envs),
        )
        monkeypatch.setitem(sys.modules, "envpool", module)

    return installed


@pytest.mark.parametrize(("part", "name"), [("obs", "action_mask"), ("info", "legal_action_mask")])
def test_actions_that_a_pool_masks_are_never_chosen(part, name, install):
    """The counter itself fails where an action is chosen that it does not allow."""
    install(part, name)
    env = make_gym("Counter-v0", 3, backend="envpool", entries=["count"], seed=0)
    step = played(env)
    even = step["observation"][..., 0] % 2 == 0
    assert torch.equal(step["action_mask"], torch.stack([torch.ones_like(even), even], -1))
    assert step["next", "done"].any() and (step["action"] == 1).any()


def test_masks_count_for_the_actions_that_the_agent_has(install):
    install("info", "action_mask")
    env = make_gym("Counter-v0", 3, backend="envpool", actions=[1, 0], seed=0)
    step = played(env)
    assert torch.equal(step["action_mask"][..., 0], step["observation"][..., 0] % 2 == 0)


def test_a_pool_without_masks_has_none(install):
    install("info", "other")
    assert "action_mask" not in make_gym("Counter-v0", 3, backend="envpool", seed=0).observation_spec.keys()  # noqa: SIM118


def test_games_of_several_players_are_refused(install):
    install("info", "legal_action_mask", players=2)
    with pytest.raises(ValueError, match="id must be that of a task for one player, got 'Counter-v0', which has 2; "):
        make_gym("Counter-v0", 3, backend="envpool")


class TestRealPools:
    @pytest.fixture
    def seeds(self, monkeypatch):
        """Those of the pools that were made."""
        envpool = pytest.importorskip("envpool")
        seeds, make = [], envpool.make

        def counting(id, *, seed, **options):
            seeds.append(seed)
            return make(id, seed=seed, **options)

        monkeypatch.setattr(envpool, "make", counting)
        return seeds

    def test_makes_one_pool_for_one_environment_and_another_for_another_seed(self, seeds):
        env = make_gym("CartPole-v1", 3, backend="envpool", max_steps=9, seed=4)
        assert len(seeds) == 1 and env.task.max_steps == 9
        first = played(env, 12)
        env.set_seed(5)
        other = played(env, 12)
        env.set_seed(4)
        again = played(env, 12)
        first_seed, second_seed, third_seed = seeds
        assert first_seed == third_seed and abs(first_seed - second_seed) > 3  # world i has the seed of the pool plus i
        assert torch.equal(first["observation"], again["observation"])
        assert not torch.equal(first["observation"], other["observation"])
        assert first["next", "truncated"].any() and first["observation"].shape == (3, 12, 4)

    def test_refuses_settings_that_the_environment_does_not_take(self, seeds):
        with pytest.raises(ValueError, match=r"settings must be arguments that CartPole-v1 takes, got \['wheels'\]"):
            make_gym("CartPole-v1", 2, backend="envpool", settings={"wheels": 4})

    def test_masks_are_those_that_the_environment_shows(self, seeds):
        env = make_gym("Game2048-v1", 3, backend="envpool", entries=["action_mask"], seed=0)
        step = played(env)
        assert torch.equal(step["action_mask"], step["observation"].bool()) and not step["action_mask"].all()
