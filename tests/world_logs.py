"""What memories hold, against what stamped worlds themselves showed."""

from __future__ import annotations

import torch


def check_sequences(algorithm) -> int:
    """Every sequence of steps shows one world, one episode, one step after the other. Returns their number."""
    found = 0
    for name, learner in algorithm.learners.items():
        if name == "meta":
            continue
        for _ in range(40):
            sample = learner.sample()
            shown = sample["observation"]
            real = sample.get(("collector", "mask"), torch.ones(sample.shape, dtype=torch.bool))[:, 1:]
            assert ((shown[:, 1:, :3] == shown[:, :-1, :3]).all(-1) | ~real).all()
            assert ((shown[:, 1:, 3] == shown[:, :-1, 3] + 1) | ~real).all()
            found += len(sample)
    return found


def options_by_hand(batches) -> list[tuple]:
    """(episode, subgoal, steps) of every option, row by row from what the worlds themselves showed."""
    whole, found = torch.cat(batches, 1), []
    for row in whole.unbind(0):
        length, last = 0, None
        for step in row.unbind(0):
            stamp = tuple(step["observation"][:3].tolist())
            starts = bool(step["option_init"])
            assert starts or stamp == last, "an option goes on in another episode"
            length, last = (1 if starts else length + 1), stamp
            if bool(step["next", "option_done"]):
                found.append((int(step["collector", "traj_ids"]), int(step["next", "active_subgoal"]), length))
    return found


def check_options(algorithm, batches) -> int:
    """The option memory holds those of the worlds' own logs, and no other one. Returns their number."""
    truth = options_by_hand(batches)
    stored = algorithm.learners["meta"].buffer[:]
    rows = zip(
        stored["collector", "traj_ids"].flatten().tolist(), stored["subgoal"].flatten().tolist(),
        stored["next", "option_steps"].flatten().tolist(), strict=True,
    )  # fmt: skip
    real = [row for row in rows if row[2] > 0]  # others are final rows
    for row in set(real):
        assert real.count(row) <= truth.count(row), row
    return len(real)
