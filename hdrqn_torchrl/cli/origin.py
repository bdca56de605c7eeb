"""What a run is told of itself: its settings, and where it comes from."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from hdrqn_torchrl.analysis.commits import codes_of
from hdrqn_torchrl.cli.resuming import Plan
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.settings.run_settings import as_plain


def record(run: Plan) -> None:
    """Writes ``config.yaml`` and ``run.json`` (where the run comes from, and with which other code it went on)."""
    from hdrqn_torchrl.runs.persistence.files import write_whole

    path, code = run.folder / layout.ORIGIN, _code()
    if not path.exists():
        origin = {
            "choices": run.choices,
            "overrides": list(HydraConfig.get().overrides.task),
            "command": " ".join(sys.argv),
            "init_from": None if run.weights is None else str(run.weights),
            **code,
        }
        write_whole(path, json.dumps(origin, indent=2) + "\n")
    elif went_on := _went_on(path, code):
        write_whole(path, json.dumps(went_on, indent=2) + "\n")
    write_whole(run.folder / layout.CONFIG, OmegaConf.to_yaml(OmegaConf.create(as_plain(run.config))))


def _code() -> dict[str, Any]:
    """Commit and versions of what runs."""
    versions = {name: version(name) for name in ("hdrqn_torchrl", "torch", "torchrl", "tensordict")}
    return {"commit": _commit(), "versions": versions}


def _went_on(path: Path, code: dict[str, Any]) -> dict[str, Any] | None:
    """What is known of a run's origin, with the code it goes on with if that is another one."""
    from hdrqn_torchrl.runs.persistence.files import read_json

    try:
        origin = read_json(path)
        known = codes_of(origin)
    except (OSError, ValueError, AttributeError):
        return None  # nobody needs it to go on
    last = {name: known[-1].get(name) for name in code}
    return None if last == code else origin | {"resumed_with": [*known[1:], code]}


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
