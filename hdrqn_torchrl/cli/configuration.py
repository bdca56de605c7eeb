"""From Hydra to plain settings: where conf/ is, and what its files compose to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import hdrqn_torchrl
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.run_settings import RunSettings, settings_of
from hdrqn_torchrl.runs.settings.trust import imports_of

ConfigStore.instance().store(name="schema", node=RunSettings)
_PACKAGE = Path(hdrqn_torchrl.__file__).parent
CONF = next(folder for folder in (_PACKAGE / "conf", _PACKAGE.parent / "conf") if (folder / "config.yaml").exists())
"""The configuration files: inside an installed package, or beside it in a checkout."""


class RunError(RuntimeError):
    """Why a training could not go on, in words for its user."""


def plain(config: DictConfig) -> dict[str, Any]:
    """The settings composed by the user's command line, every reference resolved once: plain data from here on.

    Raises:
        SettingsError: if a reference leads nowhere, or a value is missing.
    """
    try:
        found = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except (OmegaConfBaseException, RecursionError) as error:
        raise SettingsError((str(error) or "settings must not refer to themselves").splitlines()[0]) from error
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items()}


def resolved(config: DictConfig) -> RunSettings:
    """The settings of a run that a command line composed.

    Raises:
        SettingsError: as :func:`plain`, or if a setting is unknown or of another type.
    """
    settings = settings_of(plain(config))
    own = imports_of(settings.env)  # named on the user's own command line, or in a file of theirs
    return replace(settings, allowed_targets=list(dict.fromkeys([*settings.allowed_targets, *own])))
