"""All that docs/gpu.md promises, measured: ``python benchmarks/gpu.py --out gpu.json [--train] [--paper] [--worlds]``.

Prints one JSON object: a table of the goals with what was measured for each, and all figures in milliseconds of wall
time (updates) and steps a second (acting). ``--train`` adds one training of v3 over 600,000 frames, ``--paper`` one
run of the paper's gridworld comparison to its end, with the time of the study that follows from it, and ``--worlds``
whole iterations with more worlds and larger minibatches, from which defaults are to be chosen. ``--device cpu --quick``
only shows that it runs: a CPU captures nothing. It has not been run on a GPU yet.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torchrl import torchrl_logger
from torchrl.collectors import Collector

from hdrqn_torchrl.algorithms import V3_LEARNER, Algorithm, make_hdrqn, make_v3
from hdrqn_torchrl.devices import set_deterministic
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.learning import Learner, LearnerSettings
from hdrqn_torchrl.modules import compact_network, paper_network
from hdrqn_torchrl.runs.collectors.captured import CapturedCollector


def seconds_per_call(work: Callable[[], object], calls: int, *, before: int = 20) -> float:
    """Wall time of a call, once what is recorded has been recorded; waits for the device before and after."""
    for _ in range(before):
        work()
    _wait()
    start = time.perf_counter()
    for _ in range(calls):
        work()
    _wait()
    return (time.perf_counter() - start) / calls


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def v3_learner(device: str, capture: bool, precision: str) -> Learner:
    """v3 as ``algo=v3 env=gridworld`` has it, with some episodes in its memory."""
    env = MultiGoalGridEnv(64, seed=0, device=device)
    settings = {**vars(V3_LEARNER), "warmup_frames": 0, "capture": capture, "precision": precision}
    algorithm = make_v3(env, compact_network(), learner=LearnerSettings(**settings))
    return _filled(algorithm, env, 120)["joint"]


def paper_learner(device: str, capture: bool, precision: str) -> Learner:
    """The sub level with the paper's network, on the gridworld."""
    env = MultiGoalGridEnv(64, seed=0, device=device)
    settings = LearnerSettings(warmup_frames=0, capture=capture, precision=precision)  # type: ignore[arg-type]
    algorithm = make_hdrqn(env, paper_network(), version="v2", sub=settings, meta=settings)
    return _filled(algorithm, env, 60)["sub"]


def _filled(algorithm: Algorithm, env: MultiGoalGridEnv, steps: int) -> dict[str, Learner]:
    collector = Collector(
        algorithm.transform(env),
        algorithm.policy,
        frames_per_batch=env.batch_size[0] * steps,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )
    batch = next(iter(collector))
    for learner in algorithm.learners.values():
        learner.store(batch)
    return dict(algorithm.learners)


def acting_speed(device: str, worlds: int, capture: bool, batches: int) -> float:
    """Steps a second of v3's policy, worlds and transforms."""
    env = MultiGoalGridEnv(worlds, seed=0, device=device)
    algorithm = make_v3(env, compact_network(), learner=V3_LEARNER)
    options = {"frames_per_batch": worlds * 8, "total_frames": -1}
    transformed = algorithm.transform(env)
    collector = iter(
        CapturedCollector(transformed, algorithm.policy, **options)
        if capture
        else Collector(transformed, algorithm.policy, **options, auto_register_policy_transforms=False)
    )
    return worlds * 8 / seconds_per_call(lambda: next(collector), batches)


STUDY = {"algorithms": ("dqn", "drqn", "hdqn", "v1", "v2", "v3"), "seeds": 3, "frames": 1_000_000}
"""The paper's gridworld comparison: 20,000 episodes of 50 steps (conf/experiment/paper/gridworld.yaml)."""
CHOICES = ((64, 8, 1), (256, 8, 1), (1_024, 8, 4), (1_024, 8, 16), (4_096, 8, 16), (4_096, 2, 16), (16_384, 8, 64))
"""Worlds, steps of a batch, and times as large minibatches: the replay ratio is the same."""


def train(frames: int, device: str, settings: Sequence[str] = ("algo=v3",)) -> dict[str, float]:
    """One training in the gridworld, by the command line."""
    with tempfile.TemporaryDirectory() as folder:
        common = [f"total_frames={frames}", f"device={device}", "seed=0", f"hydra.run.dir={folder}", *settings]
        if frames < 10_000:
            small = ("episodes", "num_envs", "final_episodes")
            common += [*(f"evaluation.{name}=8" for name in small), "evaluation.ceilings=false"]
        command = [sys.executable, "-m", "hdrqn_torchrl.cli", "train", "env=gridworld", *common]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        summary = json.loads((Path(folder) / "summary.json").read_text())
    return {name: summary[name] for name in ("return_mean", "wall_seconds", "updates", "frames")}


def paper_study(device: str, *, quick: bool) -> dict[str, float]:
    """One run of the paper's comparison (v2, its network) to its end, and what all runs take if each takes as long."""
    frames = 512 if quick else STUDY["frames"]
    found = train(frames, device, ("algo=v2", "network=paper"))  # type: ignore[arg-type]
    runs = len(STUDY["algorithms"]) * STUDY["seeds"]  # type: ignore[arg-type, operator]
    return {**found, "runs": runs, "study_minutes": round(runs * found["wall_seconds"] / 60, 1)}


def deterministic_update(device: str, *, quick: bool) -> float:
    """Milliseconds of v3's update with ``deterministic=true``, which is of a whole process."""
    command = [sys.executable, __file__, "--device", device, "--deterministic", *(["--quick"] if quick else [])]
    return float(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))


def iteration_speed(device: str, worlds: int, steps: int, scale: int, iterations: int) -> float:
    """Frames a second of v3: collecting, storing, and all updates that are owed."""
    env = MultiGoalGridEnv(worlds, seed=0, device=device)
    settings = {**vars(V3_LEARNER), "warmup_frames": 0, "batch_scale": scale, "capacity": max(200_000, 120 * worlds)}
    algorithm = make_v3(env, compact_network(), learner=LearnerSettings(**settings))
    options = {"frames_per_batch": worlds * steps, "total_frames": -1}
    transformed = algorithm.transform(env)
    collector = iter(
        CapturedCollector(transformed, algorithm.policy, **options)
        if device == "cuda"
        else Collector(transformed, algorithm.policy, **options, auto_register_policy_transforms=False)
    )
    learner = algorithm.learners["joint"]

    def iteration() -> None:
        algorithm.observe(next(collector))
        for _ in range(learner.updates_due()):
            learner.learn()

    while learner.updates < 4 or learner.frames < 60 * worlds:  # recorded, and sequences of whole episodes are there
        iteration()
    return worlds * steps / seconds_per_call(iteration, iterations, before=2)


def measure(device: str, *, quick: bool, training: bool, paper: bool = False, worlds: bool = False) -> dict[str, Any]:
    """The table of the goals, and all figures by name."""
    captures = (False, True) if device == "cuda" else (False,)
    calls = 3 if quick else 300
    found: dict[str, Any] = {
        "device": torch.cuda.get_device_name() if device == "cuda" else platform.processor() or "cpu",
        "torch": torch.__version__,
    }
    for capture in captures:
        how = "captured" if capture else "not captured"
        for precision in ("fp32", "bf16") if device == "cuda" else ("fp32",):
            for name, make in (("v3 update", v3_learner), ("paper's sub-level update", paper_learner)):
                learner = make(device, capture, precision)
                milliseconds = 1e3 * seconds_per_call(learner.learn, calls)
                found[f"{name}, {precision}, {how}, ms"] = round(milliseconds, 3)
        for number in (64,) if quick else (64, 1_024, 4_096, 16_384):
            found[f"acting, {number} worlds, {how}, steps/s"] = round(acting_speed(device, number, capture, calls))
    found["v3 update, deterministic, ms"] = deterministic_update(device, quick=quick)
    if worlds:
        for number, steps, scale in ((16, 8, 2),) if quick else CHOICES:
            speed = iteration_speed(device, number, steps, scale, 2 if quick else 20)
            found[f"v3, {number} worlds, {steps} steps, minibatches x{scale}, frames/s"] = round(speed)
    if training:
        found["v3, gridworld"] = train(512 if quick else 600_000, device)
    if paper:
        found["paper, gridworld"] = paper_study(device, quick=quick)
    return {"table": table(found), **found}


def table(found: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Each goal with what was measured for it; ``None`` where it was not.

    Args:
        found: figures by name.
    """
    how = "captured" if any(", captured, " in name for name in found) else "not captured"
    paper, trained = found.get("paper, gridworld", {}), found.get("v3, gridworld", {})
    rows = {
        "v3 update, ms": (2.0, found.get(f"v3 update, fp32, {how}, ms")),
        "sub-level update, paper's network, ms": (2.0, found.get(f"paper's sub-level update, fp32, {how}, ms")),
        "policy and environment, 4,096 worlds, steps/s": (4e6, found.get(f"acting, 4096 worlds, {how}, steps/s")),
        "v3, 600,000 frames, seconds": (120.0, trained.get("wall_seconds")),
        "v3, 600,000 frames, return": (1.95, trained.get("return_mean")),
        "paper's comparison, minutes": (30.0, paper.get("study_minutes")),
        "v3 update with deterministic=true, ms": (None, found.get("v3 update, deterministic, ms")),
    }
    return {name: {"goal": goal, "measured": measured} for name, (goal, measured) in rows.items()}


def main() -> None:
    """Reads the command line and prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    parser.add_argument("--quick", action="store_true", help="few calls: shows only that it runs")
    parser.add_argument("--train", action="store_true", help="one whole training, too")
    parser.add_argument("--paper", action="store_true", help="one run of the paper's comparison, too")
    parser.add_argument("--worlds", action="store_true", help="iterations with more worlds, too")
    parser.add_argument("--deterministic", action="store_true", help="only v3's update with deterministic=true")
    parser.add_argument("--out", type=Path, help="also write the JSON here")
    arguments = parser.parse_args()
    if arguments.device == "cuda" and not torch.cuda.is_available():
        parser.error("device must be cpu without a usable GPU; use --device cpu --quick to see that it runs.")
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(1)
    if arguments.deterministic:
        set_deterministic(True, arguments.device)
        learner = v3_learner(arguments.device, arguments.device == "cuda", "fp32")
        print(round(1e3 * seconds_per_call(learner.learn, 3 if arguments.quick else 300), 3))
        return
    text = json.dumps(
        measure(
            arguments.device,
            quick=arguments.quick,
            training=arguments.train,
            paper=arguments.paper,
            worlds=arguments.worlds,
        ),
        indent=1,
    )
    print(text)
    if arguments.out:
        arguments.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
