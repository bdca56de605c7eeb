"""What a run is told of itself: its settings, and where it comes from."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from hdrqn_torchrl.cli.resuming import Plan
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.settings.run_settings import as_plain


def record(run: Plan) -> None:
    """Writes ``config.yaml`` and, at the beginning, ``run.json`` (where the run comes from)."""
    from hdrqn_torchrl.runs.persistence.files import write_whole

    if not (run.folder / layout.ORIGIN).exists():
        origin = {
            "choices": run.choices,
            "overrides": list(HydraConfig.get().overrides.task),
            "command": " ".join(sys.argv),
            "init_from": None if run.weights is None else str(run.weights),
            "commit": _commit(),
            "versions": {name: version(name) for name in ("hdrqn_torchrl", "torch", "torchrl", "tensordict")},
        }
        write_whole(run.folder / layout.ORIGIN, json.dumps(origin, indent=2) + "\n")
    write_whole(run.folder / layout.CONFIG, OmegaConf.to_yaml(OmegaConf.create(as_plain(run.config))))


def _commit() -> str | None:
    """Commit of this program's files, if they are part of a git repository."""
    try:
        _git("ls-files", "--error-unmatch", Path(__file__).name)  # in a repository an installed package may lie, too
        return _git("describe", "--always", "--dirty", "--abbrev=10")
    except (OSError, subprocess.CalledProcessError):
        return None


def _git(*arguments: str) -> str:
    folder = Path(__file__).parent
    return subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=True).stdout.strip()
