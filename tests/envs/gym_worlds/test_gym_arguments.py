"""What make_gym is given must change something, or is refused."""

import pytest
from gym_toys import Counter
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from hdrqn_torchrl.envs import make_gym, make_minigrid

OURS = {"wrappers": [Counter], "package": "gym_toys", "processes": True}


@pytest.mark.parametrize("name", [*OURS, "settings", "max_steps", "backend"])
def test_what_a_vector_made_elsewhere_would_ignore_is_refused(name):
    vector = SyncVectorEnv([Counter] * 2, autoreset_mode=AutoresetMode.DISABLED)
    value = {**OURS, "settings": {"ends": False}, "max_steps": 3, "backend": "envpool"}[name]
    with pytest.raises(ValueError, match=f"^{name} must be left out with a vector of worlds that was made elsewhere"):
        make_gym(vector, 2, **{name: value})


@pytest.mark.parametrize("name", OURS)
def test_what_envpool_would_ignore_is_refused(name):
    with pytest.raises(ValueError, match=f"^{name} must be left out with backend='envpool', got "):
        make_gym("CartPole-v1", 2, backend="envpool", **{name: OURS[name]})


def test_a_wrapper_that_is_a_module_is_refused():
    with pytest.raises(ValueError, match=r"^wrappers must be functions or classes .*, got <module .gym_"):
        make_gym("CartPole-v1", 2, wrappers=["gym_toys"])


def test_babyai_prints_nothing_of_the_worlds_that_it_draws_in_vain(capfd):
    pytest.importorskip("minigrid")
    make_minigrid("BabyAI-PickupDist-v0", 2, seed=0).reset()
    from minigrid.envs.babyai.core import roomgrid_level

    roomgrid_level.print("Sampling rejected:", "none")
    assert capfd.readouterr().out == ""
