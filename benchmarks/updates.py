"""One update of each level against hand-written PyTorch: ``python benchmarks/updates.py [--network paper]``.

An update is: draw a minibatch of sequences, loss, backward, gradient clipping, Adam, soft target update. Ours is
``Learner.sample`` and ``Learner.update``; the reference below does the same arithmetic on plain tensors, without
TensorDict and TorchRL, as one would write it for this one task. Both must give the same loss and gradients on the
same minibatch before anything is timed. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
from copy import deepcopy

import torch
from tensordict import TensorDictBase
from timing import compare
from torch import Tensor, nn
from torchrl import torchrl_logger
from torchrl.collectors import Collector

from hdrqn_torchrl.algorithms import Algorithm, make_hdrqn
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.learning import Learner, LearnerSettings
from hdrqn_torchrl.modules import QNetwork, compact_network, paper_network

Batch = dict[str, Tensor]
GAMMA, TAU, LEARNING_RATE, MAX_GRAD_NORM = 0.99, 1e-3, 1e-3, 10.0


class RawQNetwork(nn.Module):
    """Features -> LSTM -> dueling head on sequences ``[B, T, ...]`` from the zero state, with restarts."""

    def __init__(self, network: QNetwork) -> None:
        super().__init__()
        layers = network.features, network.memory, network.gate, network.head.streams
        self.features, self.lstm, self.gate, self.streams = (deepcopy(layer) for layer in layers)
        self.hidden_size, self.one_hot = network.hidden_size, torch.eye(network.num_conditions)

    def forward(self, observation: Tensor, subgoal: Tensor | None, init: Tensor | None) -> Tensor:
        """Q-values ``[B, T, A]``; the state restarts where ``init`` ``[B, T]`` is set."""
        features = self.features(observation)
        if subgoal is not None:
            if self.gate is not None:
                features = features * self.gate(subgoal)
            features = torch.cat([features, self.one_hot[subgoal]], -1)
        outputs = self.lstm(features)[0] if init is None else self.restarting(features, init)
        streams = self.streams(outputs)
        value, advantage = streams[..., :1], streams[..., 1:]
        return value + advantage - advantage.mean(-1, keepdim=True)

    def restarting(self, features: Tensor, init: Tensor) -> Tensor:
        """LSTM outputs, one cell call per step."""
        weights = list(self.lstm.parameters())
        keep = (~init).float().unsqueeze(-1)
        hidden = cell = features.new_zeros(len(features), self.hidden_size)
        outputs = []
        for time in range(features.shape[1]):
            kept = keep[:, time]
            hidden, cell = torch.lstm_cell(features[:, time], (hidden * kept, cell * kept), *weights)
            outputs.append(hidden)
        return torch.stack(outputs, 1)


class RawReplay:
    """Rows ``[M, ...]`` with each episode in one piece; draws sequences that start at a random row."""

    def __init__(self, rows: Batch, episode: Tensor, slice_len: int, batch_size: int) -> None:
        self.rows, self.batch_size, self.offsets = rows, batch_size, torch.arange(slice_len)
        _, lengths = episode.unique_consecutive(return_counts=True)
        self.last = (lengths.cumsum(0) - 1).repeat_interleave(lengths)  # last row of each row's episode

    def sample(self) -> Batch:
        """Sequences ``[B, T]``; past the end of an episode its last row is repeated, and ``valid`` is false."""
        start = torch.randint(len(self.last), (self.batch_size, 1))
        index, last = start + self.offsets, self.last[start]
        valid = index <= last
        index = torch.minimum(index, last)
        return {name: values[index] for name, values in self.rows.items()} | {"valid": valid}


class RawLearner:
    """Double DQN on sequences with two networks, fused Adam and a soft target update."""

    def __init__(self, network: QNetwork, replay: RawReplay, bounds: tuple[float, float]) -> None:
        self.replay, self.bounds = replay, bounds
        self.online, self.target = RawQNetwork(network), RawQNetwork(network).requires_grad_(False)
        self.parameters, self.target_parameters = list(self.online.parameters()), list(self.target.parameters())
        self.optimizer = torch.optim.Adam(self.parameters, lr=LEARNING_RATE, fused=True)

    def loss(self, batch: Batch) -> Tensor:
        """Mean squared TD error over the trained steps of sequences of T + 1; the last one shows what came of T."""
        valid, init = batch["valid"], batch["init"] & batch["valid"]
        stream, subgoal = batch["observation"], batch.get("condition")
        restart = None if subgoal is None else init
        with torch.no_grad():
            target = self.target(stream, subgoal, restart)[:, 1:]
        online = self.online(stream, subgoal, restart)
        now = {name: value[:, :-1] for name, value in batch.items()}
        chosen = online[:, :-1].gather(-1, now["action"].unsqueeze(-1)).squeeze(-1)
        with torch.no_grad():
            best = online[:, 1:]
            if "mask" in batch:
                next_mask = batch["mask"][:, 1:]
                best = best.masked_fill(~next_mask & next_mask.any(-1, keepdim=True), -torch.inf)
            next_value = target.gather(-1, best.argmax(-1, keepdim=True)).squeeze(-1)
            discount = GAMMA ** now["steps"] if "steps" in batch else GAMMA
            wanted = now["reward"] + (discount * next_value).masked_fill(now["terminated"], 0.0)
            wanted = wanted.clamp(*self.bounds)
            time = torch.arange(chosen.shape[1])
            trained = (time >= len(time) // 2) | (init[:, :-1].cumsum(1) > 0)
            trained &= now["valid"] & (now["terminated"] | (~now["done"] & valid[:, 1:]))
        return (chosen - wanted).square().mul(trained).sum() / trained.sum().clamp(min=1)

    def update(self) -> Tensor:
        """One gradient step and one target update."""
        loss = self.loss(self.replay.sample())
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, MAX_GRAD_NORM)
        self.optimizer.step()
        torch._foreach_lerp_(self.target_parameters, self.parameters, TAU)
        return loss.detach()


def flatten(level: str, version: str, steps: TensorDictBase) -> Batch:
    """The entries of our replay that a level learns from, as plain tensors of the same leading shape."""
    source = {
        "sub": {
            "observation": "observation",
            "condition": "subgoal",
            "action": "action",
            "init": "option_init",
            "reward": ("next", "intrinsic_reward"),
            "done": ("next", "option_done"),
            "terminated": ("next", "option_terminated"),
        },
        "meta": {
            "observation": "observation" if version == "v1" else "sub_hidden",
            "mask": "subgoal_mask",
            "action": "subgoal",
            "init": "is_init",
            "reward": ("next", "option_return"),
            "steps": ("next", "option_steps"),
            "done": ("next", "done"),
            "terminated": ("next", "terminated"),
        },
    }[level]
    batch = {name: steps[key] for name, key in source.items()}
    per_step = ("init", "reward", "steps", "done", "terminated")
    return {name: value.squeeze(-1) if name in per_step else value for name, value in batch.items()}


def raw_twin(learner: Learner, level: str, version: str) -> RawLearner:
    """A reference learner with the same weights and the same replay memory."""
    settings, stored = learner.settings, learner.buffer.storage[:]
    if level == "sub":  # [time, N]: put the episodes one after the other
        stored = stored.transpose(0, 1).reshape(-1)
    episode = stored["collector", "traj_ids"]
    order = episode.argsort(stable=True)
    rows = flatten(level, version, stored[order].contiguous())
    replay = RawReplay(rows, episode[order], settings.slice_len + 1, settings.batch_size)
    return RawLearner(learner.network.network, replay, (learner.loss.min_target, learner.loss.max_target))


def check_equal(learner: Learner, raw: RawLearner, level: str, version: str) -> None:
    """Checks that both give the same loss and gradients on the same minibatches."""
    for _ in range(5):
        sample = learner.sample()
        batch = flatten(level, version, sample)
        batch["valid"] = sample["collector", "mask"]
        ours, reference = learner.loss(sample)["loss"], raw.loss(batch)
        torch.testing.assert_close(ours, reference, atol=1e-5, rtol=1e-5)
        gradients = torch.autograd.grad(ours, list(learner.network.network.parameters()))
        expected = torch.autograd.grad(reference, raw.parameters)
        torch.testing.assert_close(gradients, expected, atol=1e-5, rtol=1e-3)


def filled(version: str, network: str, batches: int) -> Algorithm:
    """An algorithm whose learners have stored some episodes of random play."""
    torch.manual_seed(0)
    settings = {
        "learning_rate": LEARNING_RATE,
        "learning_rate_end": None,
        "tau": TAU,
        "max_grad_norm": MAX_GRAD_NORM,
    }
    env = MultiGoalGridEnv(num_envs=64, seed=0)
    architecture = {"compact": compact_network, "paper": paper_network}[network]()
    algorithm = make_hdrqn(
        env,
        architecture,
        version=version,
        gamma=GAMMA,
        sub=LearnerSettings(slice_len=8, **settings),
        meta=LearnerSettings(slice_len=1, capacity=50_000, **settings),
    )
    collector = Collector(
        algorithm.transform(env),
        algorithm.policy,
        frames_per_batch=64 * 8,
        total_frames=64 * 8 * batches,
        auto_register_policy_transforms=False,
    )
    for batch in collector:
        for learner in algorithm.learners.values():
            learner.store(batch)
    collector.shutdown()
    return algorithm


def main() -> None:
    """Checks, times, prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--network", choices=["compact", "paper"], default="compact")
    parser.add_argument("--blocks", type=int, default=12, help="pairs of blocks for each level")
    parser.add_argument("--seconds", type=float, default=0.8, help="length of a block")
    parser.add_argument("--batches", type=int, default=20, help="collected batches of 512 frames in the replay memory")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torchrl_logger.setLevel("WARNING")  # it writes to standard output
    result: dict[str, object] = {"network": arguments.network}
    for version, level in (("v2", "sub"), ("v2", "meta"), ("v1", "meta")):
        learner = filled(version, arguments.network, arguments.batches).learners[level]
        raw = raw_twin(learner, level, version)
        check_equal(learner, raw, level, version)
        times = compare(
            lambda learner=learner: learner.learn(),
            raw.update,
            blocks=arguments.blocks,
            seconds=arguments.seconds,
        )
        name = "sub" if level == "sub" else f"meta_{version}"
        result[name] = times | {"updates_per_second": round(1e3 / times["ours_ms"], 1)}
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
