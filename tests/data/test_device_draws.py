"""Draws that a graph can hold: the same sequences as a sampler's, as often."""

import pytest
import torch
from streams import Stream, check_sequences
from tape import Tape

from hdrqn_torchrl.data import make_sequence_buffer, sample_sequences
from hdrqn_torchrl.data.device_draws import DeviceDraws

KINDS = ["steps", "episodes", "whole_episodes", "episode_starts"]


def make(sampling, steps, *, num_envs=3, slice_len=4, lookahead=0, terminated=False):
    """A memory of 20 rows after so many steps, and draws from it."""
    buffer = make_sequence_buffer(
        20 * num_envs, slice_len=slice_len, lookahead=lookahead, batch_size=500, num_envs=num_envs, sampling=sampling,
        terminated_key=("next", "terminated") if terminated else None,
    )  # fmt: skip
    stream = Stream(num_envs)
    for _ in range(steps // 5):
        steps = stream.take(5)
        if terminated:
            steps["next", "terminated"] = steps["next", "done"] & (steps["collector", "traj_ids"] % 2 == 0).unsqueeze(
                -1
            )
        buffer.extend(steps)
    return buffer, DeviceDraws(buffer, sequences=500, length=slice_len + lookahead), stream


def counted(draw, times=40):
    """How often each start was drawn, and what the sequence from there holds."""
    counts, contents = {}, {}
    for _ in range(times):
        drawn = draw()
        for row in drawn.unbind(0):
            start = tuple(row["index"][0].tolist())
            counts[start] = counts.get(start, 0) + 1
            contents[start] = row
    return counts, contents


@pytest.mark.parametrize("terminated", [False, True])
@pytest.mark.parametrize("steps", [15, 35, 50])
@pytest.mark.parametrize("sampling", KINDS)
def test_sequences_are_those_of_the_sampler_and_as_frequent(sampling, steps, terminated):
    """By the chi-squared statistic of both counts, which has about as many degrees of freedom as there are starts."""
    buffer, draws, _ = make(sampling, steps, terminated=terminated and sampling != "episode_starts")
    draws.refresh()
    (expected, theirs), (found, ours) = counted(lambda: sample_sequences(buffer)), counted(draws.draw)
    assert found.keys() == expected.keys() and len(found) > 3
    for start, row in ours.items():
        other = theirs[start]
        assert set(row.keys(True, True)) == set(other.keys(True, True))
        assert all(torch.equal(row[key], value) for key, value in other.items(True, True))
    statistic = sum((found[each] - expected[each]) ** 2 / (found[each] + expected[each]) for each in found)
    freedom = len(found) - 1
    assert statistic < freedom + 5 * (2 * freedom) ** 0.5


def test_draws_of_episodes_with_lookahead_are_as_frequent_as_the_samplers():
    buffer, draws, _ = make("episodes", 35, slice_len=2, lookahead=2)
    draws.refresh()
    (expected, _), (found, _) = counted(lambda: sample_sequences(buffer)), counted(draws.draw)
    assert found.keys() == expected.keys()
    assert max(abs(found[each] / expected[each] - 1) for each in found if expected[each] > 300) < 0.4


def test_a_recorded_draw_goes_on_with_what_is_stored_and_with_random_numbers():
    buffer, draws, stream = make("steps", 15)
    draws.refresh()
    tape = Tape()  # the host reads nothing: it checks that
    drawn = tape.record(draws.draw)
    seen = []
    for _ in range(6):
        buffer.extend(stream.take(5))
        draws.refresh()
        tape.replay()
        check_sequences(drawn, 4, newest=set(zip(stream.episode, stream.step, strict=True)))
        seen.append(drawn["index"].clone())
    assert not torch.equal(seen[0], seen[1]) and seen[-1][..., 0].max() == 19


def test_a_table_is_made_anew_only_after_a_write(monkeypatch):
    buffer, draws, stream = make("steps", 15)
    draws.refresh()
    monkeypatch.setattr(buffer._sampler, "weights", None)
    draws.refresh()
    buffer.extend(stream.take(5))
    with pytest.raises(TypeError):
        draws.refresh()
