"""One update of hDRQNv3 against hand-written PyTorch: ``python benchmarks/updates_v3.py [--precision bf16]``.

As in ``updates.py``: draw a minibatch, loss, backward, gradient clipping, Adam, soft target update, on plain tensors
for this one task and these settings, the prediction of what will be seen included. The reference, too, runs its LSTM
through the library's kernels, over empty steps where the state restarts. Both must give the same loss and gradients
before anything is timed. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
from copy import deepcopy
from dataclasses import replace
from operator import attrgetter

import torch
from tensordict import TensorDictBase
from timing import compare
from torch import Tensor, nn
from torchrl import torchrl_logger
from torchrl.collectors import Collector

from hdrqn_torchrl.algorithms import V3_LEARNER, make_v3
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.learning import Learner
from hdrqn_torchrl.modules import AllSubgoalsNetwork, compact_network

Batch = dict[str, Tensor]
SUB_GAMMA, META_GAMMA, LAMBDA, WRONG, HAZARD = 0.9, 0.95, 0.8, -0.5, -1.0
TAU, LEARNING_RATE, MAX_GRAD_NORM, CLOSED = 0.005, 6e-4, 10.0, -1e4
AHEAD, WEIGHT = 4, 0.1


class RawNetwork(nn.Module):
    """One-hot cells -> dense layer; with the last action -> LSTM -> both heads and the predictor."""

    def __init__(self, network: AllSubgoalsNetwork) -> None:
        super().__init__()
        predictor = network.predictor
        self.features = deepcopy(network.features.dense)
        layers = predictor.memory, predictor.actions, predictor.horizon, predictor.decoder.logits
        self.expect, self.taken, self.horizon, self.cells = (deepcopy(layer) for layer in layers)
        layers = network.memory, network.sub_head, network.meta_head
        self.lstm, self.sub_head, self.meta_head = (deepcopy(layer) for layer in layers)
        self.codes, self.actions = network.features._one_hot, torch.eye(network.num_actions)
        (self.subgoals,), self.hidden = network.num_subgoals, network.hidden_size

    def forward(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Q-values ``[B, T, G, A]`` and ``[B, T, G]``, and the LSTM's output ``[B, T, H]``."""
        init = batch["init"]
        rows, steps = init.shape
        before = init.cumsum(1) - 1  # empty steps before each; every sequence starts with an episode
        length = steps + int(before[:, -1].max())
        place = ((torch.arange(steps) + before) * rows + torch.arange(rows)[:, None]).flatten()
        source = torch.zeros(length * rows, dtype=torch.int64)
        source[place] = torch.arange(rows * steps)
        empty = torch.ones(length * rows, 1)
        empty[place] = 0.0
        observation, action, first, mask = (
            batch[name].flatten(0, 1)[source] for name in ("observation", "previous_action", "init", "mask")
        )
        seen = self.features(nn.functional.embedding(observation.flatten(1).int(), self.codes).flatten(1))
        inputs = torch.cat([seen, self.actions[action] * ~first[:, None], empty], 1)
        outputs = self.run(inputs.view(length, rows, -1)).flatten(0, 1)
        sub = self.sub_head(outputs).float().view(len(outputs), self.subgoals, -1)[place]
        meta = self.meta_head(torch.cat([outputs, mask], 1)).float()[place]
        return tuple(value.unflatten(0, (rows, steps)) for value in (dueling(sub), dueling(meta), outputs[place]))

    def prediction_error(self, memory: Tensor, batch: Batch) -> Tensor:
        """Mean cross-entropy of the cells that are seen some steps ahead in the same episode."""
        ahead = int(torch.randint(1, AHEAD + 1, ()))
        last = memory.shape[1] - ahead
        place = torch.arange(ahead) * len(self.actions)
        taken = self.taken(batch["action"].unfold(1, ahead, 1)[:, :last] + place).sum(-2)
        expected = torch.relu(self.expect(memory[:, :last]) + self.horizon.weight[ahead - 1] + taken)
        cells = batch["observation"][:, ahead:].flatten(-2).long()
        logits = self.cells(expected).unflatten(-1, (cells.shape[-1], -1)).float()
        error = nn.functional.cross_entropy(logits.flatten(0, -2), cells.flatten(), reduction="none").view_as(cells)
        known = ~batch["done"][:, :-1].unfold(1, ahead, 1).any(-1)
        return (error.mean(-1) * known).sum() / known.sum()

    def run(self, inputs: Tensor) -> Tensor:
        """The LSTM over ``[L, B, I]``; the last input closes its gates."""
        weight_ih, *others = self.lstm.parameters()
        column = torch.zeros(4, self.hidden, 1)
        column[:2] = column[3] = CLOSED
        wider = torch.cat([weight_ih, column.flatten(0, 1)], 1)
        state = torch.zeros(2, 1, inputs.shape[1], self.hidden).unbind()
        return torch.lstm(inputs, state, [wider, *others], True, 1, 0.0, torch.is_grad_enabled(), False, False)[0]


def dueling(streams: Tensor) -> Tensor:
    """Value and advantages ``[*, 1 + A]`` -> ``[*, A]``."""
    value, advantage = streams[..., :1], streams[..., 1:]
    return value + advantage - advantage.mean(-1, keepdim=True)


class RawLearner:
    """Q(lambda) for all subgoals and both levels with two networks, fused Adam and a soft target update."""

    def __init__(self, learner: Learner, precision: str) -> None:
        online, target = (policy.network for policy in learner.loss._networks)
        self.online, self.target = RawNetwork(online), RawNetwork(online).requires_grad_(False)
        for parameter, (name, _) in zip(self.target.parameters(), online.named_parameters(), strict=True):
            parameter.copy_(attrgetter(name)(target))  # those of the target are buffers
        self.parameters, self.target_parameters = list(self.online.parameters()), list(self.target.parameters())
        self.optimizer = torch.optim.Adam(self.parameters, lr=LEARNING_RATE, fused=True)
        self.rows = flatten(learner.buffer.storage[:])  # [time, N, ...]
        self.count, self.steps, self.lower = (
            learner.settings.batch_size,
            learner.replay.sequence_len,
            precision == "bf16",
        )
        starts = self.rows["init"][: len(self.rows["init"]) - self.steps + 1].nonzero()
        self.time, self.environment = starts.unbind(1)

    def sample(self) -> Batch:
        """Sequences ``[B, T]`` from the start of an episode on."""
        chosen = torch.randint(len(self.time), (self.count,))
        time = self.time[chosen, None] + torch.arange(self.steps)
        return {name: values[time, self.environment[chosen, None]] for name, values in self.rows.items()}

    def loss(self, batch: Batch) -> Tensor:
        """Mean squared errors of both levels."""
        with torch.autocast("cpu", torch.bfloat16, enabled=self.lower, cache_enabled=False):
            with torch.no_grad():
                target = self.target(batch)
            online = self.online(batch)
            error = self.online.prediction_error(online[2], batch)
        with torch.no_grad():
            sub_target, meta_target, sub_trained, meta_trained = self.targets(online, target, batch)
        action = batch["action"][:, :-1, None, None].expand(*sub_target.shape, 1)
        chosen = online[0][:, :-1].gather(-1, action).squeeze(-1)
        sub, meta = (chosen - sub_target) * sub_trained, (online[1][:, :-1] - meta_target) * meta_trained
        q_loss = sub.square().sum() / sub_trained.sum() + meta.square().sum() / meta_trained.sum()
        return q_loss + WEIGHT * error

    @staticmethod
    def targets(online: tuple[Tensor, ...], target: tuple[Tensor, ...], batch: Batch) -> tuple[Tensor, ...]:
        """Targets ``[B, T, G]`` of both levels, and the entries of each that are trained."""
        now = {name: value[:, :-1] for name, value in batch.items()}
        attained, left, ended = now["attained"], now["mask"], now["terminated"][..., None]
        cut_off = (now["done"] & ~now["terminated"])[..., None]
        other = attained.sum(-1, keepdim=True) > attained.long()
        reward = attained + WRONG * other + HAZARD * now["hazard"][..., None]

        sub_next = target[0].gather(-1, online[0].argmax(-1, keepdim=True)).squeeze(-1)[:, 1:]
        mask = batch["mask"]
        allowed = online[1].masked_fill(~mask & mask.any(-1, keepdim=True), -torch.inf)
        best = target[1].gather(-1, allowed.argmax(-1, keepdim=True))[:, 1:]
        meta_next = torch.where(attained, best, target[1][:, 1:])

        agrees = online[0].argmax(-1) == batch["action"][..., None]
        unknown = cut_off & ~attained, cut_off.expand_as(attained)  # what follows is not in the sequence
        going_on = ~cut_off & agrees[:, 1:]
        going_on[:, -1] = False  # the last step's target is its value
        trace = torch.stack([going_on, going_on & ~attained])
        for level in (0, 1):
            trace[level, :, :-1] &= ~unknown[level][:, 1:]
        over = torch.stack([attained | ended | unknown[0], ended | unknown[1]])
        discount = torch.tensor([SUB_GAMMA, META_GAMMA]).view(2, 1, 1, 1).expand(over.shape).masked_fill(over, 0.0)
        kept = LAMBDA * discount * trace
        returns = torch.stack([reward, now["extrinsic_reward"][..., None].expand_as(reward)])
        returns = returns + (discount - kept) * torch.stack([sub_next, meta_next])
        for step in range(returns.shape[2] - 2, -1, -1):
            returns[:, :, step] += kept[:, :, step] * returns[:, :, step + 1]

        pursued = now["active_subgoal"][..., None] == torch.arange(left.shape[-1])
        sub_trained = left & ~unknown[0]
        return returns[0].clamp(max=1.0), returns[1], sub_trained, left & ~cut_off & (agrees[:, :-1] | pursued)

    def update(self) -> Tensor:
        """One gradient step and one target update."""
        loss = self.loss(self.sample())
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, MAX_GRAD_NORM)
        self.optimizer.step()
        torch._foreach_lerp_(self.target_parameters, self.parameters, TAU)
        return loss.detach()


def flatten(steps: TensorDictBase) -> Batch:
    """The entries that are learned from, as plain tensors with the same leading shape."""
    after = steps["next"]
    batch = {name: steps[name] for name in ("observation", "previous_action", "action")}
    batch |= {"init": steps["is_init"].squeeze(-1), "mask": steps["subgoal_mask"]}
    batch |= {name: after[name] for name in ("attained", "active_subgoal")}
    return batch | {name: after[name].squeeze(-1) for name in ("hazard", "done", "terminated", "extrinsic_reward")}


def filled(precision: str, batches: int) -> Learner:
    """A learner that has stored some episodes of random play; its networks have been trained a little."""
    torch.manual_seed(0)
    env = MultiGoalGridEnv(num_envs=64, seed=0)
    settings = replace(
        V3_LEARNER, learning_rate=LEARNING_RATE, learning_rate_end=None, tau=TAU, max_grad_norm=MAX_GRAD_NORM
    )
    algorithm = make_v3(
        env,
        compact_network(),
        learner=replace(settings, precision=precision),
        sub_gamma=SUB_GAMMA,
        meta_gamma=META_GAMMA,
        trace_decay=LAMBDA,
        wrong_subgoal_reward=WRONG,
        hazard_reward=HAZARD,
        prediction_steps=AHEAD,
        prediction_weight=WEIGHT,
    )
    learner = algorithm.learners["joint"]
    collector = Collector(
        algorithm.transform(env),
        algorithm.policy,
        frames_per_batch=64 * 8,
        total_frames=64 * 8 * batches,
        auto_register_policy_transforms=False,
    )
    for batch in collector:
        learner.store(batch)
    collector.shutdown()
    for _ in range(20):
        learner.learn()
    return learner


def check_equal(learner: Learner, raw: RawLearner) -> None:
    """Checks that both give the same loss and gradients on the same minibatches, in float32."""
    lower, raw.lower = raw.lower, False
    for _ in range(5):
        sample = learner.sample()
        with torch.random.fork_rng():  # both draw how far to look ahead
            ours = learner.loss(sample)["loss"]
        reference = raw.loss(flatten(sample))
        torch.testing.assert_close(ours, reference, atol=1e-5, rtol=1e-5)
        gradients = torch.autograd.grad(ours, list(learner.network.network.parameters()))
        expected = torch.autograd.grad(reference, raw.parameters)
        torch.testing.assert_close(gradients, expected, atol=1e-5, rtol=1e-3)
    raw.lower = lower


def main() -> None:
    """Checks, times, prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--precision", choices=["fp32", "bf16"], default="fp32")
    parser.add_argument("--blocks", type=int, default=12, help="pairs of blocks")
    parser.add_argument("--seconds", type=float, default=0.8, help="length of a block")
    parser.add_argument("--batches", type=int, default=40, help="collected batches of 512 frames in the replay memory")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torchrl_logger.setLevel("WARNING")  # it writes to standard output
    learner = filled(arguments.precision, arguments.batches)
    raw = RawLearner(learner, arguments.precision)
    check_equal(learner, raw)
    times = compare(lambda: learner.learn(), raw.update, blocks=arguments.blocks, seconds=arguments.seconds)
    updates = {"updates_per_second": round(1e3 / times["ours_ms"], 1)}
    print(json.dumps({"precision": arguments.precision, "v3": times | updates}, indent=2))


if __name__ == "__main__":
    main()
