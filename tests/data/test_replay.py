import pytest
import torch
from tensordict import TensorDict

from hdrqn_torchrl.data import make_sequence_buffer, sample_sequences

SAMPLINGS = ["steps", "episodes"]


class Stream:
    """Consecutive batches of numbered steps; episodes last 1 to 9 steps and end at other times in each environment."""

    def __init__(self, num_envs):
        self.num_envs, self.next_episode = num_envs, 0
        self.generator = torch.Generator().manual_seed(num_envs)
        self.left, self.step, self.episode = [0] * num_envs, [0] * num_envs, [0] * num_envs

    def take(self, length):
        rows = [[self._advance(n) for _ in range(length)] for n in range(self.num_envs)]
        episode, step, last = torch.tensor(rows).unbind(-1)
        done = last.bool().unsqueeze(-1)
        td = TensorDict(step=step, is_init=(step == 0).unsqueeze(-1), batch_size=[self.num_envs, length])
        td["collector", "traj_ids"] = episode
        td["next"] = TensorDict(
            done=done, terminated=done, truncated=torch.zeros_like(done), batch_size=[self.num_envs, length]
        )
        return td

    def _advance(self, n):
        if self.left[n] == 0:
            self.left[n] = int(torch.randint(1, 10, (), generator=self.generator))
            self.step[n], self.episode[n] = -1, self.next_episode
            self.next_episode += 1
        self.left[n] -= 1
        self.step[n] += 1
        return self.episode[n], self.step[n], int(self.left[n] == 0)


def check_sequences(sequences, slice_len, newest):
    """Each is one trajectory with consecutive steps, at least one of them real, padded only where it ends."""
    traj, step = sequences["collector", "traj_ids"], sequences["step"]
    real = sequences.get(("collector", "mask"), torch.ones_like(step, dtype=torch.bool))
    assert sequences.shape[1] == slice_len
    assert real[:, 0].all() and (real[:, 1:] <= real[:, :-1]).all()
    assert (traj == traj[:, :1]).all()
    assert (step == step[:, :1] + torch.arange(slice_len))[real].all()
    last = real.sum(-1, keepdim=True) - 1
    assert (step == step.gather(1, last))[~real].all()  # padding repeats the last real step
    ended = sequences["next", "terminated"].squeeze(-1).gather(1, last).squeeze(-1)
    pairs = torch.stack([traj, step], -1)[torch.arange(len(last)), last.squeeze(-1)].tolist()
    waits = torch.tensor([tuple(pair) in newest for pair in pairs])  # its episode goes on in the next batch
    assert (ended | waits)[~real[:, -1]].all()
    assert ((step == 0) == sequences["is_init"].squeeze(-1)).all()  # the flag of true starts is kept


@pytest.mark.parametrize("sampling", SAMPLINGS)
class TestSequencesOfSteps:
    @pytest.mark.parametrize("num_envs", [1, 3])
    @pytest.mark.parametrize(("length", "slice_len"), [(2, 4), (3, 4), (8, 4), (2, 1)])
    def test_each_is_one_trajectory_before_and_after_the_ring_is_full(self, num_envs, length, slice_len, sampling):
        torch.manual_seed(0)
        capacity = 60 * num_envs
        buffer = make_sequence_buffer(
            capacity, slice_len=slice_len, batch_size=16, num_envs=num_envs, sampling=sampling
        )
        stream, full = Stream(num_envs), 0
        for _ in range(180 // length):
            buffer.extend(stream.take(length))
            sequences = sample_sequences(buffer, slice_len)
            assert len(sequences) == 16
            check_sequences(sequences, slice_len, newest=set(zip(stream.episode, stream.step, strict=True)))
            full += len(buffer) == capacity
        assert full > 5

    def test_every_stored_step_is_shown(self, sampling):
        torch.manual_seed(0)
        buffer = make_sequence_buffer(90, slice_len=4, batch_size=64, num_envs=3, sampling=sampling)
        stored = Stream(3).take(30)
        buffer.extend(stored)
        seen = set()
        for _ in range(60):
            sequences = sample_sequences(buffer, 4)
            pairs = torch.stack([sequences["collector", "traj_ids"], sequences["step"]], -1)
            seen |= {tuple(pair) for pair in pairs.flatten(0, 1).tolist()}
        pairs = torch.stack([stored["collector", "traj_ids"], stored["step"]], -1).flatten(0, 1).tolist()
        assert seen == {tuple(pair) for pair in pairs}

    def test_trajectories_shorter_than_the_slice_are_padded_not_dropped(self, sampling):
        buffer, stream = make_sequence_buffer(90, slice_len=30, batch_size=8, num_envs=3, sampling=sampling), Stream(3)
        buffer.extend(stream.take(30))
        sequences = sample_sequences(buffer, 30)
        check_sequences(sequences, 30, newest=set(zip(stream.episode, stream.step, strict=True)))
        assert not sequences["collector", "mask"].all(-1).any()


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_sequences_of_options_from_rows_of_whole_episodes(sampling):
    torch.manual_seed(0)
    buffer = make_sequence_buffer(40, slice_len=8, batch_size=16, sampling=sampling)
    for episode in range(60):
        length = 1 + episode % 3  # one to three options, far fewer than the slice
        buffer.extend(one_episode(episode, length))
        sequences = sample_sequences(buffer, 8)
        check_sequences(sequences, 8, newest=set())
        assert (sequences["collector", "mask"].sum(-1) <= 3).all()
    assert len(buffer) == 40


def one_episode(number, length):
    td = TensorDict(step=torch.arange(length), batch_size=[length])
    td["collector", "traj_ids"] = torch.full((length,), number)
    td["is_init"], done = (td["step"] == 0).unsqueeze(-1), (td["step"] == length - 1).unsqueeze(-1)
    td["next"] = TensorDict(done=done, terminated=done, truncated=torch.zeros_like(done), batch_size=[length])
    return td


def start_counts(sampling):
    """How often slices of 2 start at each step of one episode of 2 and one of 8 steps."""
    torch.manual_seed(0)
    buffer = make_sequence_buffer(10, slice_len=2, batch_size=2_000, sampling=sampling)
    buffer.extend(torch.cat([one_episode(0, 2), one_episode(1, 8)]))
    starts = sample_sequences(buffer, 2)[:, 0]
    return (starts["collector", "traj_ids"] * 2 + starts["step"]).bincount(minlength=10) / len(starts)


def test_sampling_by_steps_starts_anywhere_alike():
    assert start_counts("steps").tolist() == pytest.approx([0.1] * 10, abs=0.03)


def test_sampling_by_episodes_picks_an_episode_first():
    shares = start_counts("episodes")
    assert shares[:2].sum().item() == pytest.approx(0.5, abs=0.05)


def test_the_device_is_that_of_the_storage():
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
        ({"sampling": "rows"}, "sampling must be 'steps' or 'episodes', got 'rows'; "),
    ],
)
def test_wrong_values(settings, message):
    settings = {"capacity": 100, "slice_len": 4, "batch_size": 2} | settings
    with pytest.raises(ValueError, match=message):
        make_sequence_buffer(settings.pop("capacity"), **settings)
