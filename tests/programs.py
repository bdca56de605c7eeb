"""The programs as a user calls them, and settings with which they take seconds."""

from __future__ import annotations

import os
import subprocess
import sys
import time

from processes import ROOT

CONF = ROOT / "conf"
TINY = [
    "device=cpu", "env.num_envs=8", "env.max_steps=10", "total_frames=2000", "log_frames=500", "evaluation.num_envs=8",
    "evaluation.episodes=8", "evaluation.interval_frames=1000", "evaluation.final_episodes=8", "network.hidden_size=8",
    "network.widths=[8]",
]  # fmt: skip
TINY_LEVEL = ("batch_size=4", "warmup_frames=200", "frames_per_update=100")
TINY_HDRQN = [f"algo.{level}.{setting}" for level in ("sub", "meta") for setting in TINY_LEVEL]


def wait_until(condition, seconds=120):
    """Waits, but not for ever."""
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.1)


def call(folder, *arguments):
    """Runs train.py in ``folder`` as a process of its own."""
    command = [sys.executable, *arguments]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
