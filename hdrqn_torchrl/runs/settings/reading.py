"""Settings of a run, read back from its folder. Nothing in it is trusted: see trust.py."""

from __future__ import annotations

from pathlib import Path

from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.files import RunFileError, read_json
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.run_settings import RunSettings, settings_of
from hdrqn_torchrl.runs.settings.stored_settings import read_settings


def read_config(folder: Path) -> RunSettings:
    """``config.yaml`` of a run folder.

    Raises:
        SettingsError: if there is none, or it can't be the settings of a run.
    """
    path = folder / layout.CONFIG
    if not path.is_file():
        raise SettingsError(
            f"run must be the folder of a training, got {folder}, which has no config.yaml; "
            "the default place of runs is outputs/."
        )
    try:
        return settings_of(read_settings(path))
    except RunFileError as error:
        raise SettingsError(str(error)) from error
    except (OSError, ValueError) as error:
        raise SettingsError(f"{path} can't be read as the settings of a run: {error}") from error


def read_choices(folder: Path) -> dict[str, str]:
    """Which file of each group of conf/ a run was composed of (``{"env": "gridworld", "algo": "v2", ...}``)."""
    try:
        choices = read_json(folder / layout.ORIGIN)["choices"]
        return {str(group): str(choice) for group, choice in choices.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}  # it is for headings and comparisons only
