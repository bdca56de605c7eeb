from functools import partial

import pytest
import torch
from streams import Stream, check_sequences, one_episode
from tensordict import TensorDict
from torchrl.data import SliceSampler
from torchrl.envs import Transform

from hdrqn_torchrl.data import (
    EpisodeSliceSampler,
    StepSliceSampler,
    WholeEpisodeSampler,
    make_sequence_buffer,
    sample_sequences,
)
from hdrqn_torchrl.data.device_draws import DeviceDraws
from hdrqn_torchrl.data.slices import episode_starts

PADDED = ["steps", "episodes", "whole_episodes"]


class TestSequencesOfSteps:
    @pytest.mark.parametrize("sampling", PADDED)
    @pytest.mark.parametrize("num_envs", [1, 3])
    @pytest.mark.parametrize(("length", "slice_len"), [(2, 4), (3, 4), (8, 4), (2, 1)])
    def test_each_sequence_is_one_trajectory_in_a_partial_or_full_ring(self, num_envs, length, slice_len, sampling):
        torch.manual_seed(0)
        capacity = 60 * num_envs
        buffer = make_sequence_buffer(
            capacity, slice_len=slice_len, batch_size=16, num_envs=num_envs, sampling=sampling
        )
        stream, full = Stream(num_envs), 0
        for _ in range(180 // length):
            buffer.extend(stream.take(length))
            sequences = sample_sequences(buffer)
            assert len(sequences) == 16
            check_sequences(sequences, slice_len, newest=set(zip(stream.episode, stream.step, strict=True)))
            full += len(buffer) == capacity
        assert full > 5

    @pytest.mark.parametrize("sampling", ["steps", "episodes"])
    def test_every_stored_step_is_drawn(self, sampling):
        torch.manual_seed(0)
        buffer = make_sequence_buffer(90, slice_len=4, batch_size=64, num_envs=3, sampling=sampling)
        stored = Stream(3).take(30)
        buffer.extend(stored)
        seen = set()
        for _ in range(60):
            sequences = sample_sequences(buffer)
            pairs = torch.stack([sequences["collector", "traj_ids"], sequences["step"]], -1)
            seen |= {tuple(pair) for pair in pairs.flatten(0, 1).tolist()}
        pairs = torch.stack([stored["collector", "traj_ids"], stored["step"]], -1).flatten(0, 1).tolist()
        assert seen == {tuple(pair) for pair in pairs}

    @pytest.mark.parametrize("sampling", PADDED)
    def test_trajectories_shorter_than_the_slice_are_padded_not_dropped(self, sampling):
        buffer, stream = make_sequence_buffer(90, slice_len=30, batch_size=8, num_envs=3, sampling=sampling), Stream(3)
        buffer.extend(stream.take(30))
        sequences = sample_sequences(buffer)
        check_sequences(sequences, 30, newest=set(zip(stream.episode, stream.step, strict=True)))
        assert not sequences["collector", "mask"].all(-1).any()


@pytest.mark.parametrize("sampling", PADDED)
def test_sequences_of_options_are_drawn_from_rows_of_whole_episodes(sampling):
    torch.manual_seed(0)
    buffer = make_sequence_buffer(40, slice_len=8, batch_size=16, sampling=sampling)
    for episode in range(60):
        length = 1 + episode % 3  # one to three options, far fewer than the slice
        buffer.extend(one_episode(episode, length))
        sequences = sample_sequences(buffer)
        check_sequences(sequences, 8, newest=set())
        assert (sequences["collector", "mask"].sum(-1) <= 3).all()
    assert len(buffer) == 40


def start_counts(sampling):
    """How often slices of 2 start at each step of one episode of 2 and one of 8 steps."""
    torch.manual_seed(0)
    buffer = make_sequence_buffer(10, slice_len=2, batch_size=2_000, sampling=sampling)
    buffer.extend(torch.cat([one_episode(0, 2), one_episode(1, 8)]))
    starts = sample_sequences(buffer)[:, 0]
    return (starts["collector", "traj_ids"] * 2 + starts["step"]).bincount(minlength=10) / len(starts)


def test_sampling_by_steps_starts_anywhere_with_equal_probability():
    assert start_counts("steps").tolist() == pytest.approx([0.1] * 10, abs=0.03)


def test_sampling_by_episodes_picks_an_episode_first():
    shares = start_counts("episodes")
    assert shares[:2].sum().item() == pytest.approx(0.5, abs=0.05)


class TestRandomEpisodes:
    def fill(self, sampler, num_envs, batches):
        buffer = make_sequence_buffer(40 * num_envs, slice_len=4, batch_size=64, num_envs=num_envs, sampling="episodes")
        buffer._sampler, stream = sampler or buffer._sampler, Stream(num_envs)
        for _ in range(batches):
            buffer.extend(stream.take(11))
        return buffer

    @pytest.mark.parametrize("batches", [2, 6], ids=["before", "after"])
    def test_the_slices_are_those_of_torchrls_sampler(self, batches):
        torchrls = SliceSampler(
            slice_len=4, traj_key=("collector", "traj_ids"), init_key=None, strict_length=False, pad_output=True
        )
        drawn = []
        for sampler in (torchrls, None):
            buffer = self.fill(sampler, 3, batches)
            torch.manual_seed(0)
            drawn.append(sample_sequences(buffer).select("step", ("collector", "traj_ids"), ("collector", "mask")))
        assert (drawn[0] == drawn[1]).all()

    def test_where_slices_begin_does_not_depend_on_the_lookahead(self):
        starts = []
        for lookahead in (0, 3):
            torch.manual_seed(0)
            buffer = make_sequence_buffer(
                60, slice_len=3, batch_size=400, num_envs=3, sampling="episodes", lookahead=lookahead
            )
            buffer.extend(Stream(3).take(20))
            sequences = sample_sequences(buffer)
            starts.append(sequences[:, 0].select("step", ("collector", "traj_ids")))
        assert (starts[0] == starts[1]).all()
        check_sequences(sequences, 6, newest=set(zip(*last_steps(buffer), strict=True)))
        assert not sequences["collector", "mask"].all() and sequences["collector", "mask"][:, 3:].any()


def last_steps(buffer):
    newest = buffer.storage[buffer.storage._last_cursor_index]
    return newest["collector", "traj_ids"].tolist(), newest["step"].tolist()


class TestWholeEpisodes:
    def test_episodes_are_equally_likely_and_shown_from_start_to_end(self):
        torch.manual_seed(0)
        buffer = make_sequence_buffer(10, slice_len=4, batch_size=3_000, sampling="whole_episodes")
        buffer.extend(torch.cat([one_episode(0, 2), one_episode(1, 7), one_episode(2, 1)]))
        sequences = sample_sequences(buffer)
        assert (sequences["step"][:, 0] == 0).all()
        episode, real = sequences["collector", "traj_ids"][:, 0], sequences["collector", "mask"].sum(-1)
        assert (real == torch.tensor([2, 4, 1])[episode]).all()
        assert (episode.bincount() / 3_000).tolist() == pytest.approx([1 / 3] * 3, abs=0.04)

    def test_an_episode_whose_start_was_overwritten_is_not_drawn(self):
        torch.manual_seed(0)
        buffer, stream = (
            make_sequence_buffer(24, slice_len=3, batch_size=64, num_envs=2, sampling="whole_episodes"),
            Stream(2),
        )
        beheaded = 0
        for _ in range(20):
            buffer.extend(stream.take(5))
            stored = buffer.storage[:]
            oldest = stored[(buffer.storage._last_cursor_index + 1) % len(stored)]
            beheaded += (oldest["step"] > 0).sum().item()
            assert (sample_sequences(buffer)["step"][:, 0] == 0).all()
        assert beheaded > 10

    def test_without_any_start_of_an_episode_an_error_says_what_to_do(self):
        buffer = make_sequence_buffer(4, slice_len=2, batch_size=2, sampling="whole_episodes")
        buffer.extend(one_episode(0, 6)[2:])
        with pytest.raises(RuntimeError, match="raise capacity above the length of an episode"):
            sample_sequences(buffer)


def test_sequences_are_on_the_device_of_the_storage():
    for device in ("cpu", "meta"):
        buffer = make_sequence_buffer(10, slice_len=2, batch_size=2, device=device)
        assert torch.device(buffer.storage.device).type == device


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"slice_len": 0}, "slice_len must be >= 1, got 0; "),
        ({"batch_size": 0}, "batch_size must be >= 1.*got 0; "),
        ({"capacity": 3}, "capacity must hold at least slice_len=4 .* of each of 1 environments, got 3; "),
        ({"capacity": 11, "num_envs": 3}, "capacity must hold at least slice_len=4 .* 3 environments, got 11; "),
        ({"capacity": 6, "lookahead": 3}, "slice_len=4 transitions and 3 beyond of each of 1 environments, got 6"),
        ({"lookahead": -1}, "lookahead must be >= 0 transitions, got -1; use 0"),
        ({"sampling": "rows"}, "sampling must be 'steps', 'episodes', .* or 'whole_episodes', got 'rows'; "),
        ({"sampling": "episode_starts"}, "sampling must be 'steps', .* for rows, got 'episode_starts'"),
    ],
)
def test_wrong_arguments_of_a_buffer_are_refused(settings, message):
    settings = {"capacity": 100, "slice_len": 4, "batch_size": 2} | settings
    with pytest.raises(ValueError, match=message):
        make_sequence_buffer(settings.pop("capacity"), **settings)


class TestRoomForStarts:
    """The smallest capacity that is accepted always holds a sequence; a smaller one may not."""

    @pytest.mark.parametrize("sampling", ["episode_starts", "whole_episodes"])
    @pytest.mark.parametrize(("slice_len", "lookahead"), [(4, 0), (3, 2), (13, 0)])
    def test_an_accepted_capacity_always_holds_a_sequence(self, sampling, slice_len, lookahead):
        needed = 9 + (min(slice_len + lookahead, 9) if sampling == "whole_episodes" else slice_len + lookahead) - 1
        make = partial(
            make_sequence_buffer,
            slice_len=slice_len,
            lookahead=lookahead,
            batch_size=1,
            num_envs=1,
            sampling=sampling,
            episode_len=9,
        )
        with pytest.raises(
            ValueError, match=f"hold an episode of 9 and slice_len={slice_len} .*; use at least {needed}"
        ):
            make(needed - 1)
        for exponent in (None, 0.9):
            buffer, episode = make(needed, priority_exponent=exponent), None
            for number in range(6):
                episode = one_episode(number, 9)
                for step in episode:
                    buffer.extend(step.reshape(1, 1))
                    assert buffer.can_sample() or not buffer.is_full()
            assert buffer.is_full()

    def test_a_capacity_of_one_step_less_sometimes_holds_no_sequence(self):
        buffer = make_sequence_buffer(11, slice_len=4, batch_size=1, num_envs=1, sampling="episode_starts")
        able = []
        for number in range(6):
            for step in one_episode(number, 9):
                buffer.extend(step.reshape(1, 1))
                able.append(buffer.can_sample())
        assert able[:4] == [False, False, False, True] and 0 < sum(not each for each in able[20:]) < 5

    def test_any_capacity_is_accepted_if_lengths_are_unknown_or_sequences_begin_anywhere(self):
        make_sequence_buffer(4, slice_len=4, batch_size=1, num_envs=1, sampling="episode_starts")
        make_sequence_buffer(4, slice_len=4, batch_size=1, num_envs=1, sampling="steps", episode_len=9)


@pytest.mark.parametrize("sampling", [*PADDED, "episode_starts"])
@pytest.mark.parametrize("exponent", [None, 0.9])
def test_whether_a_sequence_can_be_drawn_is_known_before_it_is(sampling, exponent):
    if sampling == "episodes" and exponent:
        return
    stream, able = Stream(2), []
    buffer = make_sequence_buffer(
        16, slice_len=5, batch_size=4, num_envs=2, sampling=sampling, priority_exponent=exponent
    )
    assert not buffer.can_sample()
    for _ in range(40):
        buffer.extend(stream.take(1))
        able.append(buffer.can_sample())
        if able[-1]:
            sample_sequences(buffer)
        else:
            with pytest.raises(RuntimeError, match=r"no stored (start|episode|step)"):
                sample_sequences(buffer)
    if sampling == "episode_starts":
        assert 5 < sum(able) < 38


@pytest.mark.parametrize("sampling", [*PADDED, "episode_starts"])
@pytest.mark.parametrize("batches", [1, 3, 5, 8, 12], ids="after {} batches".format)
class TestState:
    """A copy of a memory draws the same sequences, before and after it is full."""

    def make(self, sampling):
        return make_sequence_buffer(3 * 20, slice_len=4, batch_size=16, num_envs=3, sampling=sampling)

    def test_a_copy_of_a_memory_draws_and_stores_alike(self, sampling, batches):
        stream, first, second = Stream(3), self.make(sampling), self.make(sampling)
        second.extend(Stream(3).take(20))
        for _ in range(batches):
            first.extend(stream.take(6))
        if batches > 2:
            sample_sequences(first)
        second.load_state_dict(first.state_dict())
        for _ in range(6):
            if batches > 2 or len(first) > 40:
                assert len(first) == len(second)
                drawn = []
                for buffer in (first, second):
                    torch.manual_seed(batches)
                    drawn.append(sample_sequences(buffer))
                assert (drawn[0] == drawn[1]).all()
                if sampling != "episode_starts":
                    check_sequences(drawn[1], 4, newest=set(zip(stream.episode, stream.step, strict=True)))
            batch = stream.take(4)
            first.extend(batch.clone())
            second.extend(batch.clone())

    def test_the_state_of_a_memory_is_as_large_as_what_was_stored(self, sampling, batches):
        buffer, stream = self.make(sampling), Stream(3)
        for _ in range(batches):
            buffer.extend(stream.take(6))
        stored = buffer.state_dict()["_storage"]["stored"]
        assert len(stored) == min(6 * batches, 20)


def test_the_state_of_an_empty_memory_is_restored():
    first, second = (make_sequence_buffer(60, slice_len=4, batch_size=4, num_envs=3) for _ in range(2))
    second.extend(Stream(3).take(10))
    second.load_state_dict(first.state_dict())
    assert len(second) == 0
    batch = Stream(3).take(8)
    second.extend(batch)
    assert len(second) == 24 and sample_sequences(second).shape == (4, 4)


def test_the_state_of_a_memory_of_options_is_restored():
    first, second = (make_sequence_buffer(10, slice_len=3, batch_size=16) for _ in range(2))
    for number in range(7):
        first.extend(one_episode(number, 1 + number % 3))
    second.load_state_dict(first.state_dict())
    for number in range(7, 12):
        drawn = []
        for buffer in (first, second):
            torch.manual_seed(number)
            drawn.append(sample_sequences(buffer))
            buffer.extend(one_episode(number, 1 + number % 3))
        assert (drawn[0] == drawn[1]).all()


class Recorder:
    """Feeds a buffer with a stream and remembers when, in units of steps, episodes started in each environment."""

    def __init__(self, num_envs, slice_len, *, rows=40, batch_size=64):
        self.stream, self.rows, self.slice_len, self.now = Stream(num_envs), rows, slice_len, 0
        self.starts = []
        settings = {"slice_len": slice_len, "batch_size": batch_size, "num_envs": num_envs}
        self.buffer = make_sequence_buffer(rows * num_envs, sampling="episode_starts", **settings)

    def extend(self, length):
        batch = self.stream.take(length)
        time, env = torch.arange(length) + self.now, torch.arange(self.stream.num_envs)
        batch["time"], batch["env"] = time.expand(batch.shape).clone(), env[:, None].expand(batch.shape).clone()
        self.starts += [(n, self.now + t) for n, t, _ in batch["is_init"].nonzero().tolist()]
        self.now += length
        self.buffer.extend(batch)

    def skip(self, length):
        """Steps that are collected and never stored."""
        self.stream.take(length)

    def unbroken_starts(self):
        """Valid starts whose slice does not go from one episode to another that it did not lead to."""
        rows = self.buffer.storage[:].flatten()
        columns = (rows["env"], rows["time"], rows["collector", "traj_ids"], rows["next", "done"].squeeze(-1))
        stored = {
            (env, time): (traj, done) for env, time, traj, done in zip(*map(torch.Tensor.tolist, columns), strict=True)
        }

        def is_broken(env, time):
            (traj, done), (next_traj, _) = stored[env, time], stored[env, time + 1]
            return traj != next_traj and not done

        steps = range(self.slice_len - 1)
        return {
            (env, time) for env, time in self.valid_starts() if not any(is_broken(env, time + step) for step in steps)
        }

    def valid_starts(self):
        """(environment, time) of starts that are stored with all the steps of a slice."""
        oldest, last = max(0, self.now - self.rows), self.now - self.slice_len
        return {(env, time) for env, time in self.starts if oldest <= time <= last}

    def sample(self):
        return sample_sequences(self.buffer)


class TestEpisodeStarts:
    @pytest.mark.parametrize("num_envs", [1, 3])
    @pytest.mark.parametrize(("length", "slice_len"), [(2, 4), (7, 4), (8, 13), (3, 1), (40, 13)])
    def test_slices_start_where_an_episode_does_and_go_on_without_a_gap(self, num_envs, length, slice_len):
        recorder, wrapped = Recorder(num_envs, slice_len), 0
        for _ in range(130 // length):
            recorder.extend(length)
            valid = recorder.valid_starts()
            if not valid:
                continue
            sequences = recorder.sample()
            assert sequences.shape == (64, slice_len)
            assert sequences["is_init"][:, 0].all()
            assert (sequences["time"] == sequences["time"][:, :1] + torch.arange(slice_len)).all()
            assert (sequences["env"] == sequences["env"][:, :1]).all()
            drawn = set(zip(sequences["env"][:, 0].tolist(), sequences["time"][:, 0].tolist(), strict=True))
            assert drawn <= valid and len(drawn) >= min(3, len(valid))
            wrapped += recorder.now > recorder.rows
        assert wrapped >= 2

    def test_slices_from_episode_starts_run_on_into_the_next_episodes(self):
        recorder = Recorder(3, 13)
        recorder.extend(40)
        sequences = recorder.sample()
        traj, init = sequences["collector", "traj_ids"], sequences["is_init"].squeeze(-1)
        assert (traj[:, 1:] != traj[:, :-1]).any(1).all()  # episodes last 9 steps at most
        assert ((traj[:, 1:] != traj[:, :-1]) == init[:, 1:]).all()
        assert ("collector", "mask") not in sequences.keys(True)

    @pytest.mark.parametrize("batches", [3, 9], ids=["before", "after"])
    def test_all_starts_are_equally_likely_before_and_after_the_ring_is_full(self, batches):
        recorder = Recorder(2, 6, batch_size=6_000)
        for _ in range(batches):
            recorder.extend(11)
        first, valid = recorder.sample()[:, 0], sorted(recorder.valid_starts())
        found = list(zip(first["env"].tolist(), first["time"].tolist(), strict=True))
        counts = torch.tensor([found.count(start) for start in valid]).double()
        expected = 6_000 / len(valid)
        assert counts.sum() == 6_000 and len(valid) > 5
        assert ((counts - expected) ** 2 / expected).sum().item() < len(valid) + 6 * (2 * len(valid)) ** 0.5

    @pytest.mark.parametrize("lost", [1, 2, 7, 13])
    def test_no_slice_spans_lost_steps(self, lost):
        """Where batches are missing, an episode is followed by a later one that it did not lead to."""
        recorder, joined = Recorder(3, 6, rows=60), 0
        for number in range(24):
            if number % 3 == 2:
                recorder.skip(lost)
            recorder.extend(5)
            if number < 8:
                continue
            sequences = recorder.sample()
            after = sequences[:, 1:]
            new = after["collector", "traj_ids"] != sequences["collector", "traj_ids"][:, :-1]
            assert sequences["next", "done"][:, :-1].squeeze(-1)[new].all()
            drawn = set(zip(sequences["env"][:, 0].tolist(), sequences["time"][:, 0].tolist(), strict=True))
            allowed = recorder.unbroken_starts()
            assert drawn <= allowed
            joined += len(recorder.valid_starts() - allowed)
        assert joined > 5

    def test_an_interrupted_episode_is_not_joined_to_the_next(self):
        """The collector started again: the same numbers of episodes, and no end before a start."""
        done = torch.zeros(6, 1, dtype=torch.bool)
        init, episode = torch.tensor([1, 0, 0, 1, 0, 0]).bool()[:, None], torch.zeros(6, 1)
        starts = episode_starts(init, episode, done, newest=5, length=3)
        assert starts.flatten().tolist() == [True, False, False, True, False, False]
        assert episode_starts(init, episode, done, newest=5, length=4).flatten().tolist() == [False] * 6
        done[2] = True
        assert episode_starts(init, episode, done, newest=5, length=4).flatten().tolist() == [True] + [False] * 5

    def test_without_a_start_with_enough_steps_an_error_says_what_to_do(self):
        recorder = Recorder(2, 12)
        recorder.extend(10)
        with pytest.raises(RuntimeError, match=r"slice_len=12 stored steps; update later, raise capacity or use"):
            recorder.sample()
        recorder.extend(2)
        assert recorder.sample()["time"][:, 0].unique().tolist() == [0]


@pytest.mark.parametrize("sampling", [*PADDED, "episode_starts"])
def test_loading_a_memory_clears_the_caches_of_its_sampler(sampling):
    settings = {"slice_len": 4, "batch_size": 64, "num_envs": 2, "sampling": sampling}
    source, target = (make_sequence_buffer(40, **settings) for _ in range(2))
    stream = Stream(2)
    target.extend(stream.take(20))
    sample_sequences(target)
    for _ in range(2):
        source.extend(stream.take(13))
    target.load_state_dict(source.state_dict())
    drawn = []
    for buffer in (source, target):
        torch.manual_seed(0)
        drawn.append(sample_sequences(buffer))
    assert (drawn[0] == drawn[1]).all()


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (StepSliceSampler, {"slice_len": 0}, "slice_len must be >= 1, got 0"),
        (WholeEpisodeSampler, {"slice_len": 0}, "slice_len must be >= 1, got 0"),
        (EpisodeSliceSampler, {"slice_len": 2, "lookahead": 2}, r"lookahead must lie in \[0, slice_len=2\), got 2"),
    ],
)
def test_samplers_refuse_lengths_that_make_no_sense(kind, settings, message):
    with pytest.raises(ValueError, match=message):
        kind(**settings)


def test_transforms_change_what_is_stored_and_what_is_drawn():
    """As in TorchRL's buffers: bytes in the memory, numbers from 0 to 1 outside."""

    class Bytes(Transform):
        def _inv_call(self, tensordict):
            return tensordict.set("value", (tensordict["value"] * 255).round().byte())

        def forward(self, tensordict):
            return tensordict.set("value", tensordict["value"].float() / 255)

    buffer = make_sequence_buffer(16, slice_len=4, batch_size=3, num_envs=2)
    buffer.append_transform(Bytes())
    steps = {"value": torch.full((2, 5, 1), 0.6), "collector": {"traj_ids": torch.tensor([[0] * 5, [1] * 5])}}
    buffer.extend(TensorDict(steps, [2, 5]))
    assert buffer[:]["value"].dtype == torch.float32 and buffer._storage[:]["value"].dtype == torch.uint8
    assert (sample_sequences(buffer)["value"] == 0.6).all()


def test_sequences_have_the_length_that_the_buffer_draws():
    buffer = make_sequence_buffer(40, slice_len=4, batch_size=3, num_envs=2, lookahead=2)
    steps = {"step": torch.arange(10).expand(2, 10), "collector": {"traj_ids": torch.arange(2)[:, None].expand(2, 10)}}
    buffer.extend(TensorDict(steps, [2, 10]))
    for _ in range(20):
        drawn = sample_sequences(buffer)
        real = drawn["collector", "mask"].squeeze(-1)
        assert drawn.shape == (3, 6) and drawn["step"].diff(dim=1)[real[:, 1:]].eq(1).all()


def test_draws_inside_a_graph_refuse_transforms():
    buffer = make_sequence_buffer(16, slice_len=4, batch_size=3, num_envs=2)
    buffer.append_transform(Transform())
    draws = DeviceDraws(buffer, sequences=3, length=4)
    with pytest.raises(ValueError, match=r"buffer must have no transforms .*, got 1: .* capture=False"):
        draws.refresh()
