"""Updates and acting on a GPU, captured and not: ``python benchmarks/gpu.py [--out FILE] [--train]``.

Prints one JSON object, in milliseconds of wall time (updates) and steps a second (acting). ``--train`` adds the time
of one training of v3 over 600,000 frames and what it reached. ``--device cpu --quick`` only shows that it runs: a CPU
captures nothing. It has not been run on a GPU yet.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torchrl import torchrl_logger
from torchrl.collectors import Collector

from hdrqn_torchrl.algorithms import V3_LEARNER, Algorithm, make_hdrqn, make_v3
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.learning import Learner, LearnerSettings
from hdrqn_torchrl.modules import compact_network, paper_network
from hdrqn_torchrl.runs.captured_collector import CapturedCollector


def seconds_per_call(work: Callable[[], object], calls: int) -> float:
    """Wall time of a call, once what is recorded has been recorded; waits for the device before and after."""
    for _ in range(20):
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


def train(frames: int, device: str) -> dict[str, float]:
    """One training of v3, by the command line."""
    with tempfile.TemporaryDirectory() as folder:
        settings = [f"total_frames={frames}", f"device={device}", "seed=0", f"hydra.run.dir={folder}"]
        command = [sys.executable, "-m", "hdrqn_torchrl.cli", "train", "env=gridworld", "algo=v3", *settings]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        summary = json.loads((Path(folder) / "summary.json").read_text())
    return {name: summary[name] for name in ("return_mean", "wall_seconds", "updates", "frames")}


def measure(device: str, *, quick: bool, training: bool) -> dict[str, object]:
    """All figures, by name."""
    captures = (False, True) if device == "cuda" else (False,)
    calls = 3 if quick else 300
    found: dict[str, object] = {
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
        for worlds in (64,) if quick else (64, 1_024, 4_096, 16_384):
            found[f"acting, {worlds} worlds, {how}, steps/s"] = round(acting_speed(device, worlds, capture, calls))
    if training:
        found["v3, gridworld"] = train(600_000, device)
    return found


def main() -> None:
    """Reads the command line and prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    parser.add_argument("--quick", action="store_true", help="few calls: shows only that it runs")
    parser.add_argument("--train", action="store_true", help="one whole training, too")
    parser.add_argument("--out", type=Path, help="also write the JSON here")
    arguments = parser.parse_args()
    if arguments.device == "cuda" and not torch.cuda.is_available():
        parser.error("device must be cpu without a usable GPU; use --device cpu --quick to see that it runs.")
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(1)
    text = json.dumps(measure(arguments.device, quick=arguments.quick, training=arguments.train), indent=1)
    print(text)
    if arguments.out:
        arguments.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
