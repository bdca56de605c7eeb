import pytest
import torch
from torchrl.collectors import Collector

from hdrqn_torchrl.algorithms import make_hdrqn
from hdrqn_torchrl.data import OptionHistory
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.learner import LearnerSettings
from hdrqn_torchrl.modules import compact_network

ROOM = ("#####", "#   #", "#   #", "#   #", "#####")


def filled_meta_learner(meta_input="both", meta_input_time="after_last_decision", steps=12, max_steps=12):
    torch.manual_seed(0)
    env = MultiGoalGridEnv(6, layout=ROOM, num_goals=3, num_obstacles=1, max_steps=max_steps, view=3, seed=0)
    algorithm = make_hdrqn(
        env,
        compact_network(hidden_size=8, widths=(16,)),
        meta_input=meta_input,
        meta_input_time=meta_input_time,
        refresh_hidden_steps=steps,
        meta=LearnerSettings(slice_len=2, batch_size=64, capacity=1000),
    )
    collector = Collector(
        algorithm.transform(env),
        algorithm.policy,
        frames_per_batch=6 * 5,
        total_frames=6 * 5 * 20,
        auto_register_policy_transforms=False,
    )
    meta = algorithm.learners["meta"]
    for batch in collector:
        meta.store(batch)
    return algorithm, meta


def states(part):
    return torch.cat([part["sub_hidden"], part["sub_cell"]], -1)


@pytest.mark.parametrize("meta_input_time", ["after_last_decision", "after_last_observation"])
def test_with_the_same_weights_the_states_are_those_seen_when_acting(meta_input_time):
    _, meta = filled_meta_learner(meta_input_time=meta_input_time)
    refresh, meta.refresh = meta.refresh, None
    stored = meta.sample()
    refreshed = refresh(stored.clone())
    assert (stored["next", "history_steps"] > 1).any() and (stored["history_steps"] > 0).any()
    torch.testing.assert_close(states(refreshed), states(stored))
    torch.testing.assert_close(states(refreshed["next"]), states(stored["next"]))


def test_with_new_weights_the_states_change_except_at_the_start_of_an_episode():
    algorithm, meta = filled_meta_learner()
    refresh, meta.refresh = meta.refresh, None
    stored = meta.sample()
    with torch.no_grad():
        for parameter in algorithm.policy.sub_controller.network.parameters():
            parameter.add_(0.1)
    refreshed = refresh(stored.clone())
    first = stored["is_init"].squeeze(-1)
    assert (states(refreshed)[first] == 0).all()
    assert (states(refreshed) != states(stored)).any(-1)[~first].all()
    assert (states(refreshed["next"]) != states(stored["next"])).any(-1).all()


def test_states_after_longer_options_stay_as_stored():
    algorithm, meta = filled_meta_learner(steps=3)
    refresh, meta.refresh = meta.refresh, None
    stored = meta.sample()
    with torch.no_grad():
        algorithm.policy.sub_controller.network.memory.bias_ih_l0.add_(0.5)
    changed = (states(refresh(stored.clone())["next"]) != states(stored["next"])).any(-1)
    assert torch.equal(changed, stored["next", "option_steps"].squeeze(-1) <= 3)


def test_a_refreshed_sample_is_learned_from():
    _, meta = filled_meta_learner(meta_input="hidden")
    assert meta.update(meta.sample())["loss"] > 0


def test_max_steps_must_be_positive():
    with pytest.raises(ValueError, match="max_steps must be >= 1, got 0"):
        OptionHistory(0)
