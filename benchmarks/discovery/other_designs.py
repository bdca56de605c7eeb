"""Other ways to tell events, in random play in the room of 3x3 cells: how well the best event of each matches a goal.

    python benchmarks/discovery/other_designs.py seed=0

- Anomalies (after Rafati and Noelle, 2019): a recurrent predictor of v3's size is trained until its loss is flat. What
  changed in the steps that surprise it most is clustered by k-means: either the change itself, or what was seen less
  what was expected.
- The same clusters of all steps, without a predictor.
- Changes: "this place goes from code a to code b", all of them, or the first time in an episode alone.

The predictor is trained on other play (frames=96_000, updates=3_000) than is scored. Each goal is compared with the
cluster or change that has the best F1 there, which no agent could choose: these are upper bounds.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import mean
from typing import NamedTuple

import torch
from clusters import k_means, scored
from matching import first_times
from predictor import Predictor, errors
from random_play import TASKS, random_play
from torch import Tensor
from torch.nn.functional import one_hot

from hdrqn_torchrl import keys
from hdrqn_torchrl.cli.command_line import command_line

CODES, EPISODE = 5, 16
SHARES, CLUSTERS = (0.02, 0.05, 0.1, 0.2), (4, 8, 16, 32)


@dataclass
class Settings:
    """Arguments; the module's docstring explains them."""

    seed: int = 0
    frames: int = 96_000
    updates: int = 3_000


def train(predictor: Predictor, play: Episodes, updates: int) -> None:
    """On whole episodes; the learning rate falls to zero."""
    optimizer = torch.optim.Adam(predictor.parameters(), 2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
    losses = []
    for update in range(1, updates + 1):
        rows = torch.randint(len(play.views), (64,))
        loss = errors(predictor(play.views[rows], play.action[rows]), play.after[rows])[play.real[rows]].mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
        if update % (updates // 10) == 0:
            print(f"update {update}: loss {mean(losses[-updates // 10 :]):.3f} nats a step", flush=True)


def places_in_episodes(done: Tensor) -> tuple[Tensor, Tensor]:
    """The episode of each step and its place there, ``[N, T]``."""
    ended = done.flatten().clone().view_as(done)
    ended[:, -1] = True
    episode = (ended.flatten().cumsum(0) - ended.flatten().long()).view_as(done)
    first = torch.cat([torch.zeros(1, dtype=torch.int64), ended.flatten().nonzero().flatten() + 1])
    return episode, torch.arange(done.numel()).view_as(done) - first[episode]


def in_episodes(steps: Tensor, place: tuple[Tensor, Tensor]) -> Tensor:
    """Steps ``[N, T, ...]`` by episode ``[E, EPISODE, ...]``, zeros behind their end."""
    whole = steps.new_zeros((int(place[0].max()) + 1, EPISODE, *steps.shape[2:]))
    whole[place] = steps
    return whole


class Episodes(NamedTuple):
    """Random play by episode ``[E, EPISODE, ...]``; views are one-hot ``[*, P, C]``."""

    views: Tensor
    action: Tensor
    after: Tensor
    real: Tensor
    true: Tensor
    changes: Tensor
    first_changes: Tensor


def play(frames: int, seed: int) -> Episodes:
    """Steps of the room with goals and changes of each."""
    steps = random_play(TASKS["room"].make(seed), frames, seed)
    after, done = steps.get("next"), steps["next", keys.DONE].squeeze(-1)
    old, new = (each[keys.OBSERVATION].flatten(-2).long() for each in (steps, after))
    changes = one_hot(old * CODES + new, CODES**2).bool() & (old != new).unsqueeze(-1)
    changes = changes.flatten(-2)  # [N, T, P * codes * codes]
    views, seen = (one_hot(each, CODES).float() for each in (old, new))
    every = (views, steps[keys.ACTION], seen, torch.ones_like(done), after[keys.ATTAINED], changes)
    place = places_in_episodes(done)
    return Episodes(*(in_episodes(each, place) for each in (*every, first_times(changes, done))))


def run(settings: Settings) -> None:
    """Plays, trains, clusters, prints."""
    torch.set_num_threads(1)
    torch.manual_seed(settings.seed)
    predictor = Predictor(9, CODES, 4)
    train(predictor, play(settings.frames, settings.seed + 1_000), settings.updates)
    scene = play(9_600, settings.seed)
    real, true = scene.real, scene.true[scene.real]
    with torch.no_grad():
        logits = predictor(scene.views, scene.action)
    surprise, unexpected = errors(logits, scene.after)[real], (scene.after - logits.softmax(-1))[real].flatten(-2)
    changed = (scene.after - scene.views)[real].flatten(-2)
    print(f"other play: loss {surprise.mean():.3f} nats a step; goals taken: {true.sum()} of {len(true)} steps\n")
    print("| events | precision / recall, mean of both goals |\n|---|---|")
    for share in SHARES:
        top = surprise.topk(round(share * len(surprise))).indices
        print(f"| the {share:.0%} most surprising steps | {scored(true, top, torch.ones(len(top), 1))} |")
        for name, points in (("what changed", changed[top]), ("seen less expected", unexpected[top])):
            results = ", ".join(f"k={k}: {scored(true, top, one_hot(k_means(points, k), k))}" for k in CLUSTERS)
            print(f"| of these, clusters of {name} | {results} |", flush=True)
    every = torch.arange(len(true))
    results = ", ".join(f"k={k}: {scored(true, every, one_hot(k_means(changed, k), k))}" for k in CLUSTERS)
    print(f"| all steps, clusters of what changed | {results} |")
    print(f"| changes | {scored(true, every, scene.changes[real])} |")
    print(f"| changes, the first time in an episode | {scored(true, every, scene.first_changes[real])} |")


if __name__ == "__main__":
    command_line(Settings, __doc__ or "", run)
