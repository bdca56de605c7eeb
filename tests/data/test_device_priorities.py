"""Priorities as tensors: what a graph of a GPU needs beyond what :mod:`test_prioritized` says of both kinds."""

from copy import deepcopy

import pytest
import torch
from streams import Stream, check_sequences
from tape import Tape
from waits import HostWaits

from hdrqn_torchrl.data import PrioritizedSequenceSampler, make_sequence_buffer
from hdrqn_torchrl.data.device_draws import DeviceDraws
from hdrqn_torchrl.data.device_priorities import DevicePrioritySampler, cumulative, pick


def make_memory(sampling="steps"):
    """A memory of 20 rows of three environments."""
    return make_sequence_buffer(
        60, slice_len=4, batch_size=50, num_envs=3, sampling=sampling, priority_exponent=0.7, importance_exponent=0.5
    )


@pytest.mark.parametrize("sampling", ["steps", "episode_starts", "whole_episodes"])
def test_nothing_but_the_first_question_reads_on_the_host(sampling, as_on_gpu):
    buffer, stream = make_memory(sampling), Stream(3)
    draws = DeviceDraws(buffer, sequences=50, length=4)
    for _ in range(6):
        steps = stream.take(5)
        buffer.extend(steps)
        with HostWaits() as waits:
            draws.refresh()
            sample = draws.draw()
            draws.set_priorities(sample, torch.ones(50))
        assert waits.found == []


def test_a_recorded_draw_follows_the_priorities_that_it_sets(as_on_gpu):
    buffer, stream = make_memory(), Stream(3)
    draws = DeviceDraws(buffer, sequences=50, length=4)
    buffer.extend(stream.take(10))
    draws.refresh()

    def work():
        drawn = draws.draw()
        draws.set_priorities(drawn, (drawn["collector", "traj_ids"][:, 0] == 2) * 1000.0)
        return drawn

    tape = Tape()
    drawn = tape.record(work)
    for _ in range(6):
        tape.replay()
        check_sequences(drawn, 4, newest=set(zip(stream.episode, stream.step, strict=True)))
    assert (drawn["collector", "traj_ids"][:, 0] == 2).float().mean() > 0.9
    old = drawn["index"].clone()
    for _ in range(6):  # over all that was stored
        buffer.extend(stream.take(5))
        draws.refresh()
    tape.replay()
    assert (drawn["collector", "traj_ids"] > 2).all() and not torch.equal(drawn["index"], old)
    assert drawn["priority_weight"][:, 0].unique().tolist() == pytest.approx([(1000 + 1e-3) ** -0.35], rel=1e-4)


def test_of_several_priorities_for_one_start_the_largest_counts(as_on_gpu):
    buffer = make_memory()
    buffer.extend(Stream(3).take(10))
    buffer.sample()
    buffer.update_priority(torch.zeros(3, 2, dtype=torch.int64), torch.tensor([1.0, 5.0, 2.0]))
    powers = buffer._sampler.state_dict()["priorities"]
    assert powers[0].item() == pytest.approx((5 + 1e-3) ** 0.7)


def test_trees_and_tensors_load_the_states_of_each_other(request):
    buffers = [make_memory()]
    request.getfixturevalue("as_on_gpu")
    buffers.append(make_memory())
    kinds = [type(each._sampler) for each in buffers]
    assert kinds == [PrioritizedSequenceSampler, DevicePrioritySampler]
    for source, other in (buffers, buffers[::-1]):
        source.empty()
        source.extend(Stream(3).take(10))
        source.update_priority(source.sample()["index"], torch.rand(200))
        state = deepcopy(source.state_dict())
        other.load_state_dict(deepcopy(state))
        found, expected = other.state_dict()["_sampler"], state["_sampler"]
        assert all(torch.equal(found[name], expected[name]) for name in ("priorities", "starts"))
        assert found["largest"] == pytest.approx(expected["largest"])


def test_a_folder_holds_what_the_state_does(as_on_gpu, tmp_path):
    buffer, other = make_memory(), make_memory()
    buffer.extend(Stream(3).take(10))
    buffer.update_priority(buffer.sample()["index"], torch.rand(200))
    buffer._sampler.dumps(tmp_path / "sampler")
    other._sampler.loads(tmp_path / "sampler")
    states = [each._sampler.state_dict() for each in (buffer, other)]
    assert all(torch.equal(states[0][name], states[1][name]) for name in ("priorities", "starts"))


class TestPick:
    def test_places_are_drawn_in_proportion_to_their_weights(self):
        weight = torch.tensor([0.0, 1.0, 0.0, 1e-6, 3.0, 0.0])
        counts = pick(cumulative(weight), 40_000).bincount(minlength=6)
        assert counts[[0, 2, 5]].tolist() == [0, 0, 0]
        assert counts[4] / counts[1] == pytest.approx(3, rel=0.05)

    def test_sums_are_of_whole_numbers_and_fit(self):
        """Sums of floats have no fixed order on a GPU, and are refused where numbers must repeat."""
        sums = cumulative(torch.full((2**22,), 5.0))
        assert sums.dtype == torch.int64 and sums[-1] == 2**62 and (sums.diff() > 0).all()

    def test_without_any_weight_a_place_exists_nevertheless(self):
        assert pick(cumulative(torch.zeros(5)), 3).max() < 5
