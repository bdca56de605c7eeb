import pytest
import torch
from helpers import batches_of, random_play
from torchrl.collectors import Collector

from hdrqn_torchrl.algorithms import make_hdrqn
from hdrqn_torchrl.data import OptionExtractor, OptionHistory
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.learning import LearnerSettings
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
    refresh, meta.replay.refresh = meta.replay.refresh, None
    stored = meta.sample()
    refreshed = refresh(stored.clone())
    assert (stored["history_steps"] > 1).any()
    torch.testing.assert_close(states(refreshed), states(stored))


def test_with_new_weights_the_states_change_except_at_the_start_of_an_episode():
    algorithm, meta = filled_meta_learner()
    refresh, meta.replay.refresh = meta.replay.refresh, None
    stored = meta.sample()
    with torch.no_grad():
        for parameter in algorithm.policy.sub_controller.network.parameters():
            parameter.add_(0.1)
    refreshed = refresh(stored.clone())
    first = stored["is_init"].squeeze(-1)
    assert (states(refreshed)[first] == 0).all()
    assert (states(refreshed) != states(stored)).any(-1)[~first].all()


def test_states_after_longer_options_stay_as_stored():
    algorithm, meta = filled_meta_learner(steps=3)
    refresh, meta.replay.refresh = meta.replay.refresh, None
    stored = meta.sample()
    with torch.no_grad():
        algorithm.policy.sub_controller.network.memory.bias_ih_l0.add_(0.5)
    changed = (states(refresh(stored.clone())) != states(stored)).any(-1)
    steps = stored["history_steps"].squeeze(-1)
    assert torch.equal(changed, (steps > 0) & (steps <= 3)) and (steps > 3).any()


def test_a_refreshed_sample_can_be_learned_from():
    _, meta = filled_meta_learner(meta_input="hidden")
    assert meta.update(meta.sample())["loss"] > 0


def test_a_history_needs_a_positive_max_steps():
    with pytest.raises(ValueError, match="max_steps must be >= 1, got 0"):
        OptionHistory(0)


HISTORY = ("history", "history_steps", "history_subgoal")


def extract(steps, carry=lambda extractor: extractor):
    """Options with their histories, batch by batch; ``carry`` may replace the extractor between two batches."""
    extractor, taken = OptionExtractor(history=OptionHistory(5)), []
    for batch in batches_of(steps, 3):
        options = extractor(batch)
        taken += [] if options is None else [options]
        extractor = carry(extractor)
    return torch.cat(taken, 0)


def assert_same_histories(options, expected):
    steps = options["history_steps"].flatten()
    assert (steps == expected["history_steps"].flatten()).all()
    assert (options["history_subgoal"] == expected["history_subgoal"])[steps > 0].all()
    for row, length in enumerate(steps.tolist()):
        assert length == 0 or (options["history"][row, : length + 1] == expected["history"][row, : length + 1]).all()


def test_a_history_is_that_of_the_option_before_in_the_same_episode():
    options = extract(random_play(4, 60))
    same = options["collector", "traj_ids"][1:] == options["collector", "traj_ids"][:-1]
    assert (options["history_steps"][1:][same] == options["next", "option_steps"][:-1][same]).all()
    assert not options["history_steps"][options["is_init"]].any()


@pytest.mark.parametrize("num_envs", [1, 6])
def test_an_option_whose_predecessor_is_unknown_has_no_history(num_envs):
    """The first batch begins in mid-episode: what was observed before it is unknown."""
    steps = random_play(num_envs, 62)[:, 2:]
    options = extract(steps)
    traj = options["collector", "traj_ids"]
    first = torch.cat([torch.tensor([True]), traj[1:] != traj[:-1]])
    assert (first & ~options["is_init"].flatten()).any()
    assert not options["history_steps"][first].any()


def test_a_state_dict_carries_the_options_in_progress():
    def carry(extractor):
        successor = OptionExtractor(history=OptionHistory(5))
        successor.load_state_dict(extractor.state_dict())
        return successor

    steps = random_play(4, 60)
    assert_same_histories(extract(steps, carry), extract(steps))


def test_a_state_dict_is_a_snapshot():
    steps = random_play(4, 60)
    extractor, successor = (OptionExtractor(history=OptionHistory(5)) for _ in range(2))
    extractor(steps[:, :20])
    snapshot = extractor.state_dict()
    extractor(steps[:, 40:])
    successor.load_state_dict(snapshot)
    reference = OptionExtractor(history=OptionHistory(5))
    reference(steps[:, :20])
    assert_same_histories(successor(steps[:, 20:40]), reference(steps[:, 20:40]))
