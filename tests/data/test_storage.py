from copy import deepcopy
from functools import cache

import pytest
import torch
from streams import Stream, one_episode

from hdrqn_torchrl.data import make_sequence_buffer, sample_sequences

PLAIN = [(sampling, None) for sampling in ("steps", "episodes", "episode_starts", "whole_episodes")]
SAMPLINGS = PLAIN + [(sampling, 0.9) for sampling, _ in PLAIN if sampling != "episodes"]
every_sampling = pytest.mark.parametrize(("sampling", "priority_exponent"), SAMPLINGS)


def make(capacity, sampling="steps", priority_exponent=None, num_envs=3, slice_len=4):
    return make_sequence_buffer(
        capacity,
        slice_len=slice_len,
        batch_size=16,
        num_envs=num_envs,
        sampling=sampling,
        priority_exponent=priority_exponent,
    )


@cache
def stream_of_batches(length, count):
    stream = Stream(3)
    return [stream.take(length) for _ in range(count)]


def drawn(buffer, seed):
    """A sample, whose priorities are then set if there are any; ``None`` where none can be drawn."""
    torch.manual_seed(seed)
    if not buffer.can_sample():
        return None
    sample = sample_sequences(buffer)
    if "priority_weight" in sample:
        buffer.update_priority(sample["index"][:, 0], torch.rand(len(sample)))
    return sample


@every_sampling
@pytest.mark.parametrize("capacity", [30, 32], ids="capacity {}".format)
@pytest.mark.parametrize("length", [1, 4, 13], ids="batches of {}".format)
def test_a_copy_of_a_memory_of_steps_goes_on_as_the_original(sampling, priority_exponent, capacity, length):
    """Before, while and after the ring is full for the first time; copies of copies; draws, writes, priorities."""
    first, compared = make(capacity, sampling, priority_exponent), 0
    copies = []
    for number, batch in enumerate(stream_of_batches(length, 5 + 24 // length)):
        first.extend(batch.clone())
        for copy in copies:
            copy.extend(batch.clone())
        expected = drawn(first, number)
        for copy in copies:
            assert len(copy) == len(first) and copy.is_full() == first.is_full()
            sample = drawn(copy, number)
            assert (sample is None) == (expected is None)
            assert expected is None or (sample == expected).all()
            compared += expected is not None
        if number % max(1, 8 // length) == 0:
            copies = [*copies[-1:], make(capacity, sampling, priority_exponent)]
            copies[-1].load_state_dict(deepcopy((copies[-2] if len(copies) > 1 else first).state_dict()))
    assert compared > 5 and first.is_full()


@pytest.mark.parametrize("capacity", [10, 11])
def test_a_copy_of_a_memory_of_options_goes_on_as_the_original(capacity):
    first, second = make(capacity, num_envs=None), None
    for number in range(30):
        if second is not None:
            assert (drawn(second, number) == drawn(first, number)).all()
            second.extend(one_episode(number, 1 + number % 3))
        first.extend(one_episode(number, 1 + number % 3))
        if number % 3 == 0:
            second = make(capacity, num_envs=None)
            second.load_state_dict(deepcopy(first.state_dict()))
    assert len(first) == capacity


@every_sampling
def test_an_emptied_memory_is_as_good_as_new(sampling, priority_exponent):
    used, new = make(32, sampling, priority_exponent), make(32, sampling, priority_exponent)
    for batch in stream_of_batches(4, 5):
        used.extend(batch.clone())
        drawn(used, 0)
    used.empty()
    copy = make(32, sampling, priority_exponent)
    copy.load_state_dict(deepcopy(used.state_dict()))
    for number, batch in enumerate(stream_of_batches(4, 5)):
        expected = []
        for buffer in (new, used, copy):
            buffer.extend(batch.clone())
            expected.append(drawn(buffer, number))
        assert [each is None for each in expected] == [expected[0] is None] * 3
        assert expected[0] is None or all((each == expected[0]).all() for each in expected)


class TestBatches:
    def test_a_single_step_is_a_batch(self):
        one_by_one, at_once = make(60), make(60)
        for batch in stream_of_batches(1, 26):
            one_by_one.extend(batch.clone())
        at_once.extend(torch.cat(stream_of_batches(1, 26), 1))
        assert self.steps(one_by_one) == self.steps(at_once) and len(one_by_one) == len(at_once) == 60

    @staticmethod
    def steps(buffer):
        stored = buffer.storage[:]
        return {
            *zip(stored["collector", "traj_ids"].flatten().tolist(), stored["step"].flatten().tolist(), strict=True)
        }

    @every_sampling
    def test_of_too_many_steps_the_newest_are_kept_in_order(self, sampling, priority_exponent):
        buffer, batch = make(60, sampling, priority_exponent), Stream(3).take(53)
        buffer.extend(batch.clone())
        assert len(buffer) == 60 and (batch["step"][:, -20:] == buffer.storage[:]["step"].T).all()
        sample = drawn(buffer, 0)
        step, init = sample["step"], sample["is_init"].squeeze(-1)
        assert ((step[:, 1:] - step[:, :-1] <= 1) & ((step == 0) == init)[:, 1:]).all()

    def test_of_too_many_options_the_newest_are_kept(self):
        buffer = make(10, num_envs=None)
        buffer.extend(one_episode(0, 3))
        buffer.extend(one_episode(1, 25))
        assert sorted(buffer.storage[:]["step"].tolist()) == list(range(15, 25))

    @pytest.mark.parametrize(
        ("num_envs", "batch", "message"),
        [
            (3, lambda: Stream(2).take(4), r"the shape \[3, T\] that this memory was built for, got \[2, 4\]; give"),
            (3, lambda: Stream(6).take(4), r"got \[6, 4\]; "),
            (3, lambda: one_episode(0, 3), r"got \[3\]; "),
            (3, lambda: Stream(3).take(4).unsqueeze(0), r"got \[1, 3, 4\]; "),
            (None, lambda: Stream(3).take(4), r"the shape \[M\] that .*, got \[3, 4\]; "),
        ],
    )
    def test_batches_of_another_shape_are_refused_and_change_nothing(self, num_envs, batch, message):
        buffer = make(60, num_envs=num_envs)
        with pytest.raises(ValueError, match=message):
            buffer.extend(batch())
        assert len(buffer) == 0


class TestStatesThatAreRefused:
    """Each leaves the memory as it was."""

    def refused(self, state, message, buffer):
        before = drawn(buffer, 0) if len(buffer) else None
        with pytest.raises(ValueError, match=message):
            buffer.load_state_dict(state)
        assert before is None or (drawn(buffer, 0) == before).all()

    def state(self, **settings):
        buffer = make(**({"capacity": 60} | settings))
        buffer.extend(Stream(3).take(9) if buffer.storage.ndim == 2 else one_episode(0, 9))
        return deepcopy(buffer.state_dict())

    @pytest.mark.parametrize(
        ("saved", "message"),
        [
            ({"capacity": 90}, r"must have 20 rows of shape \[3\], got 30 of \[3\]; load it with the capacity"),
            ({"num_envs": None}, r"must have 20 rows of shape \[3\], got 60 of \[\]; "),
        ],
        ids=["capacity", "rows"],
    )
    def test_a_state_of_another_size_is_refused(self, saved, message):
        buffer = make(60)
        buffer.extend(Stream(3).take(9))
        self.refused(self.state(**saved), message, buffer)

    @pytest.mark.parametrize("newest", [-1, 9, 10**9])
    def test_a_state_whose_newest_row_is_not_stored_is_refused(self, newest):
        state = self.state()
        state["_storage"]["last_cursor"] = newest
        self.refused(state, f"the newest among them, got 9 with the newest at {newest}; it is damaged", make(60))

    @pytest.mark.parametrize("cursor", [-1, 20, 10**9])
    def test_a_state_whose_next_row_lies_outside_the_ring_is_refused(self, cursor):
        state = self.state()
        state["_writer"]["_cursor"] = cursor
        self.refused(state, rf"next row must lie in \[0, 20\), got {cursor}; it is damaged", make(60))

    def test_a_state_with_more_than_its_rows_is_refused(self):
        state = self.state(capacity=90)
        state["_storage"]["rows"] = 20
        state["_storage"]["stored"] = torch.cat([state["_storage"]["stored"]] * 3)
        self.refused(state, "must hold 1 to 20 rows, the newest among them, got 27", make(60))

    def test_priorities_of_another_size_or_none_are_refused(self):
        good = self.state(priority_exponent=0.9)
        for name, value, message in (
            ("priorities", torch.ones(61), r"must be those of 60 steps, got \[61\] and \[60\]"),
            ("starts", torch.ones(59, dtype=torch.bool), r"got \[60\] and \[59\]"),
            ("starts", torch.ones(60), "must be those of 60 steps"),
            ("priorities", torch.full((60,), float("nan")), "must be finite and > 0"),
            ("priorities", torch.full((60,), -1.0), "must be finite and > 0"),
            ("largest", float("inf"), "must be finite and > 0"),
        ):
            state = deepcopy(good)
            state["_sampler"]["starts"][0] = True
            state["_sampler"][name] = value
            self.refused(state, message, make(60, priority_exponent=0.9))
