import copy

import numpy
import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint

from hdrqn_torchrl.data import make_sequence_buffer, sample_sequences
from hdrqn_torchrl.data.slices import steps_left
from hdrqn_torchrl.runs.persistence.serialization import SafetensorsAdapter

SAMPLINGS = ["steps", "episode_starts", "whole_episodes"]
ALPHA, FLOOR = 0.7, 1e-3


@pytest.fixture(autouse=True, params=["trees", "tensors"])
def kind(request):
    """Priorities lie in trees of the host, or in tensors, as on a GPU."""
    if request.param == "tensors":
        request.getfixturevalue("as_on_gpu")
    return request.param


class World:
    """Environments whose episodes have drawn lengths, a prioritised memory of them, and which steps are stored when."""

    def __init__(self, sampling, *, num_envs=3, rows=30, slice_len=4, batch_size=64, longest=9, seed=0):
        self.sampling, self.rows, self.slice_len, self.now = sampling, rows, slice_len, 0
        self.generator = torch.Generator().manual_seed(seed)
        self.num_envs, self.longest = num_envs, longest
        self.left, self.episode = [0] * num_envs, [-1] * num_envs
        self.log = {}  # (env, time): episode, whether it starts one, whether it ends one
        self.buffer = make_sequence_buffer(
            rows * num_envs,
            slice_len=slice_len,
            batch_size=batch_size,
            num_envs=num_envs,
            sampling=sampling,
            priority_exponent=ALPHA,
        )

    def take(self, length):
        """The next steps ``[N, length]``."""
        for env in range(self.num_envs):
            for time in range(self.now, self.now + length):
                starts = self.left[env] == 0
                if starts:
                    self.left[env] = int(torch.randint(1, self.longest + 1, (), generator=self.generator))
                    self.episode[env] += 1
                self.left[env] -= 1
                self.log[env, time] = 1_000 * env + self.episode[env], starts, self.left[env] == 0
        self.now += length
        cells = [
            [(env, t, *self.log[env, t]) for t in range(self.now - length, self.now)] for env in range(self.num_envs)
        ]
        env, time, episode, init, done = torch.tensor(cells).unbind(-1)
        steps = TensorDict(env=env, time=time, is_init=init.bool().unsqueeze(-1), batch_size=env.shape)
        steps["collector", "traj_ids"] = episode
        steps["next"] = TensorDict(done=done.bool().unsqueeze(-1), batch_size=env.shape)
        return steps

    def extend(self, length):
        self.buffer.extend(self.take(length))

    def complete(self):
        """Starts (env, time) by hand, with the number of real steps of their slice."""
        found = {}
        for env, time in self.log:
            if time < self.now - self.rows or (self.sampling != "steps" and not self.log[env, time][1]):
                continue
            slice_ = [(env, time + step) for step in range(self.slice_len)]
            if self.sampling != "episode_starts":
                slice_ = [cell for cell in slice_ if self.log.get(cell, (None,))[0] == self.log[env, time][0]]
            whole = len(slice_) == self.slice_len or self.log[slice_[-1]][2]
            if whole and all(cell in self.log for cell in slice_):
                found[env, time] = len(slice_)
        return found

    def sample(self):
        return sample_sequences(self.buffer)

    def set_priorities(self, priority_of):
        """Draws until every complete start was drawn, and sets its priority."""
        for _ in range(200):
            sample = self.sample()
            first = sample[:, 0]
            values = [
                priority_of(env, time) for env, time in zip(first["env"].tolist(), first["time"].tolist(), strict=True)
            ]
            self.buffer.update_priority(first["index"], torch.tensor(values))
            self.seen = getattr(self, "seen", set()) | set(starts_of(sample))
            if self.seen >= set(self.complete()):
                return
        raise AssertionError("not all starts were drawn")


def starts_of(sample):
    return list(zip(sample["env"][:, 0].tolist(), sample["time"][:, 0].tolist(), strict=True))


@pytest.mark.parametrize("sampling", SAMPLINGS)
class TestSlices:
    @pytest.mark.parametrize(("num_envs", "length"), [(1, 7), (3, 4), (2, 13)])
    @pytest.mark.parametrize("slice_len", [1, 4, 11])
    def test_each_slice_is_complete_and_crosses_no_end_and_no_seam(self, sampling, num_envs, length, slice_len):
        torch.manual_seed(0)
        world, wrapped, short = World(sampling, num_envs=num_envs, slice_len=slice_len), 0, 0
        for _ in range(100 // length):
            world.extend(length)
            complete = world.complete()
            if not complete:
                continue
            sample = world.sample()
            real, time = sample["collector", "mask"], sample["time"]
            for row, start in enumerate(starts_of(sample)):
                assert real[row].sum() == complete[start]
            place = torch.arange(slice_len).minimum(real.sum(1, keepdim=True) - 1)
            assert (time == time[:, :1] + place).all() and (sample["env"] == sample["env"][:, :1]).all()
            if sampling != "episode_starts":
                assert (sample["collector", "traj_ids"] == sample["collector", "traj_ids"][:, :1]).all()
            world.buffer.update_priority(sample["index"][:, 0], torch.rand(64))
            wrapped, short = wrapped + (world.now > world.rows), short + (~real).any().item()
        assert wrapped >= 2
        assert (short > 0) == (slice_len > 1 and sampling != "episode_starts")

    @pytest.mark.parametrize("batches", [4, 13], ids=["before", "after"])
    def test_every_complete_start_is_drawn_in_proportion_to_its_priority(self, sampling, batches):
        """Before and after the ring is full."""
        torch.manual_seed(0)
        world = World(sampling, batch_size=1_000)
        for _ in range(batches):
            world.extend(5)
        priorities = {start: 0.05 + (7 * start[0] + start[1]) % 5 for start in world.complete()}
        world.set_priorities(lambda *start: priorities[start])
        drawn = [start for _ in range(8) for start in starts_of(world.sample())]
        scaled = {start: (priority + FLOOR) ** ALPHA for start, priority in priorities.items()}
        expected = torch.tensor([8_000 * value / sum(scaled.values()) for value in scaled.values()])
        counts = torch.tensor([drawn.count(start) for start in scaled])
        assert counts.sum() == 8_000 and len(scaled) > 5
        distance = ((counts - expected) ** 2 / expected).sum().item()  # chi square with n - 1 degrees of freedom
        assert distance < len(scaled) + 5 * (2 * len(scaled)) ** 0.5

    def test_weights_correct_for_the_priorities(self, sampling):
        torch.manual_seed(0)
        world = World(sampling)
        world.extend(25)
        world.set_priorities(lambda env, time: 0.1 + env + time)
        sample = world.sample()
        wanted = torch.tensor([(0.1 + sum(start) + FLOOR) ** (-ALPHA * 0.6) for start in starts_of(sample)])
        assert sample["priority_weight"].shape == (64, 4)
        torch.testing.assert_close(sample["priority_weight"], wanted.unsqueeze(-1).expand(64, 4))


def test_a_capacity_that_is_not_a_multiple_of_num_envs_is_rounded_up():
    """The storage rounds it up."""
    buffer, world = None, World("steps", longest=1)
    buffer = make_sequence_buffer(64, slice_len=2, batch_size=512, num_envs=3, sampling="steps", priority_exponent=1.0)
    for _ in range(12):
        buffer.extend(world.take(4))
    sample = sample_sequences(buffer)
    assert len(set(starts_of(sample))) == len(buffer) == 66
    buffer.update_priority(sample["index"][:, 0], torch.rand(512))


class TestNewSteps:
    def test_new_steps_have_the_largest_priority_so_far(self):
        torch.manual_seed(0)
        world = World("steps", batch_size=4_000, rows=60)
        world.extend(20)
        old = set(world.complete())
        world.set_priorities(lambda env, time: 8.0 if (env, time) == min(old) else 0.5)
        world.set_priorities(lambda *_: 0.5)  # the largest one is gone, and remembered
        world.extend(10)
        new = set(world.complete()) - old
        drawn = starts_of(world.sample())
        share = sum(start in new for start in drawn) / len(drawn)
        mass = len(new) * (8 + FLOOR) ** ALPHA, len(old) * (0.5 + FLOOR) ** ALPHA
        assert share == pytest.approx(mass[0] / sum(mass), abs=0.03)

    def test_starts_whose_slice_became_complete_are_new(self):
        """They were stored before, when their episode had too few steps."""
        torch.manual_seed(0)
        world = World("whole_episodes", num_envs=1, slice_len=20, rows=60, longest=30)
        world.left, world.episode = [25], [0]
        world.extend(3)
        with pytest.raises(RuntimeError, match=r"slice_len=20 steps; update later, raise capacity or use shorter"):
            world.sample()
        world = World("steps", num_envs=1, slice_len=5, rows=60)
        world.left, world.episode = [40], [0]
        world.extend(6)
        assert set(starts_of(world.sample())) == {(0, 0), (0, 1)}
        world.buffer.update_priority(torch.tensor([[0, 0], [1, 0]]), torch.tensor([0.0, 0.0]))
        world.extend(2)
        assert set(starts_of(world.sample())) >= {(0, 2), (0, 3)}

    def test_steps_that_were_rewritten_are_new(self):
        torch.manual_seed(0)
        world = World("steps", rows=60)
        world.extend(20)
        world.set_priorities(lambda env, time: 8.0 if time == 3 else 0.5)
        world.buffer.rewrite(lambda steps, newest: None)
        sample = world.sample()
        assert len(set(starts_of(sample))) > 15
        weight = sample["priority_weight"][:, 0]
        assert (weight == weight[0]).all() and weight[0].item() == pytest.approx((8 + FLOOR) ** (-ALPHA * 0.6))

    def test_overwritten_steps_leave_no_priority(self):
        torch.manual_seed(0)
        world = World("steps", num_envs=2, rows=12, longest=1)
        world.extend(12)
        world.set_priorities(lambda *_: 100.0)
        late = world.sample()
        world.extend(12)  # over all of them
        world.buffer.update_priority(late["index"][:, 0], torch.full((64,), 5_000.0))  # too late
        sample = world.sample()
        assert len(set(starts_of(sample))) > 15 and (sample["time"] >= 12).all()
        weight = sample["priority_weight"][:, 0]
        assert (weight == weight[0]).all() and weight[0].item() == pytest.approx((100 + FLOOR) ** (-ALPHA * 0.6))


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_a_random_number_of_zero_draws_the_first_start(sampling, monkeypatch):
    """float32 has it once in 2**24 numbers."""
    world = World(sampling, num_envs=1, rows=12, seed=4)
    world.extend(19)
    first = min(world.complete())
    assert first != (0, 12)  # at place 0 of the ring
    rand = torch.rand
    monkeypatch.setattr(torch, "rand", lambda *size, **settings: rand(*size, **settings) * 0)
    assert set(starts_of(world.sample())) <= set(world.complete())


class TestRows:
    """Storages of one dimension: options, whole episodes in one piece."""

    def episode(self, number, length):
        td = TensorDict(step=torch.arange(length), batch_size=[length])
        td["collector", "traj_ids"] = torch.full((length,), number)
        td["is_init"] = (td["step"] == 0).unsqueeze(-1)
        td["next"] = TensorDict(done=(td["step"] == length - 1).unsqueeze(-1), batch_size=[length])
        return td

    @pytest.mark.parametrize("sampling", ["steps", "whole_episodes"])
    def test_slices_of_rows_are_drawn_by_priority(self, sampling):
        torch.manual_seed(0)
        settings = {"slice_len": 3, "batch_size": 256, "sampling": sampling, "priority_exponent": 1.0}
        buffer = make_sequence_buffer(20, **settings)
        for number in range(40):
            buffer.extend(self.episode(number, 1 + number % 4))
            sample = sample_sequences(buffer)
            episode, step, real = sample["collector", "traj_ids"], sample["step"], sample["collector", "mask"]
            assert (episode == episode[:, :1]).all()
            left = 1 + episode[:, 0] % 4 - step[:, 0]
            assert (real.sum(1) == left.clamp(max=3)).all()
            assert sampling == "steps" or (step[:, 0] == 0).all()
        rows = sample["index"][:, 0]
        buffer.update_priority(rows, (step[:, 0] == 0) * 1.0)
        assert (sample_sequences(buffer)["step"][:, 0] == 0).float().mean() > 0.9


class TestState:
    @pytest.mark.parametrize("sampling", SAMPLINGS)
    @pytest.mark.parametrize("batches", [3, 11], ids=["before", "after"])
    def test_a_copy_draws_and_updates_priorities_alike(self, sampling, batches, tmp_path):
        """Through a file, into a memory with another past; then many draws, writes and new priorities."""
        torch.manual_seed(0)
        first, second = World(sampling), World(sampling, seed=1)
        for _ in range(5):
            second.extend(9)
            second.buffer.update_priority(second.sample()["index"][:, 0], torch.rand(64))
        for _ in range(batches):
            first.extend(9)
            first.buffer.update_priority(first.sample()["index"][:, 0], 3 * torch.rand(64))
        Checkpoint().register("memory", first.buffer, adapter=SafetensorsAdapter()).save(tmp_path / "saved")
        Checkpoint().register("memory", second.buffer, adapter=SafetensorsAdapter()).load(tmp_path / "saved")
        steps = [first.take(5) for _ in range(8)]
        drawn = []
        for world in (first, second):
            torch.manual_seed(5)
            drawn.append([])
            for batch in steps:
                for _ in range(6):
                    sample = world.sample()
                    drawn[-1].append(sample)
                    world.buffer.update_priority(sample["index"][:, 0], torch.rand(64) / (1 + sample["time"][:, 0]))
                world.buffer.extend(batch.clone())
        first, second = (torch.stack(samples) for samples in drawn)
        assert len(first) == 48 and (first == second).all()

    def test_the_state_of_an_empty_sampler_is_restored(self):
        first, second = World("steps"), World("steps")
        second.extend(9)
        second.sample()
        second.buffer.load_state_dict(copy.deepcopy(first.buffer.state_dict()))
        with pytest.raises(RuntimeError):
            second.sample()
        second.extend(9)
        assert (second.sample()["priority_weight"] == (1 + FLOOR) ** (-ALPHA * 0.6)).all()

    def test_only_torchs_random_numbers_decide_what_is_drawn(self):
        world, drawn = World("steps"), []
        world.extend(20)
        for seed in (0, 0, 1):
            torch.manual_seed(seed)
            numpy.random.seed(len(drawn))
            drawn.append(starts_of(world.sample()))
        assert drawn[0] == drawn[1] != drawn[2]


def test_steps_left_agrees_with_a_plain_loop():
    generator = torch.Generator().manual_seed(0)
    for newest in range(7):
        episode = torch.randint(3, (7, 4), generator=generator).cumsum(0)
        done = torch.randint(2, (7, 4), generator=generator).bool()
        left, ended = steps_left(episode, done, newest)
        for row in range(7):
            for env in range(4):
                last = row
                while last != newest and episode[(last + 1) % 7, env] == episode[row, env]:
                    last = (last + 1) % 7
                assert left[row, env] == (last - row) % 7 + 1 and ended[row, env] == done[last, env]


def test_sampling_episodes_by_priority_is_refused():
    with pytest.raises(ValueError, match=r"sampling must be 'steps', .* with priority_exponent, got 'episodes'"):
        make_sequence_buffer(100, slice_len=4, batch_size=2, sampling="episodes", priority_exponent=0.5)
