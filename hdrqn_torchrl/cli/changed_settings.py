"""Settings of a run and settings given with its resume: which changed, and what they come to together."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import Any

from omegaconf import OmegaConf

from hdrqn_torchrl.cli.configuration import plain
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.building import default_of
from hdrqn_torchrl.runs.settings.comparing import BOOKKEEPING, flat
from hdrqn_torchrl.runs.settings.run_settings import RunSettings, Settings, as_plain, settings_of

FOLLOWS = "learning_rate_frames"
"""Settings of this name that are equal to ``total_frames`` are raised with it."""


def with_overrides(
    stored: RunSettings, stored_choices: dict[str, str], given: RunSettings, overrides: list[str]
) -> RunSettings:
    """A run's settings with those changed that were given on the command line.

    Args:
        stored: the run's settings.
        stored_choices: the run's choices of groups.
        given: what the whole command line composes to.
        overrides: the command line.
    """
    config, composed = OmegaConf.create(as_plain(stored)), OmegaConf.create(as_plain(given))
    for override in overrides:
        key, _, value = override.lstrip("+~").partition("=")
        if stored_choices.get(key) == value:
            continue
        if key in stored_choices and key not in config:
            raise SettingsError(f"{override} can't be given with resume=FOLDER: settings come from that run.")
        OmegaConf.update(config, key, OmegaConf.select(composed, key), merge=False, force_add=True)
    if config.total_frames > stored.total_frames:
        given_too = {override.lstrip("+~").partition("=")[0] for override in overrides}
        for path in set(_following(as_plain(stored))) - given_too:
            OmegaConf.update(config, path, config.total_frames)
    return replace(
        settings_of(plain(config)),
        allowed_targets=given.allowed_targets,  # never from the run folder
        resume=given.resume,
        resume_override=given.resume_override,
    )


def _following(settings: dict[str, Any]) -> list[str]:
    """Full names of the settings that end when the training does."""
    total, found = settings["total_frames"], flat(settings["algo"], path="algo")
    return [key for key, value in found.items() if key.endswith(FOLLOWS) and value == total]


def differences(stored: Settings, config: Settings) -> list[str]:
    """Settings that changed, one line each. Raising ``total_frames`` does not count, nor does what follows it.

    A setting that only one of them has, as the other is of an earlier version, has its builder's default there.
    """
    before, after = (flat(_without_copies(deepcopy(each)), without=BOOKKEEPING) for each in (stored, config))
    frames = before.pop("total_frames"), after.pop("total_frames")
    changed = [f"total_frames: {frames[0]} -> {frames[1]} (it can only be raised)"] if frames[1] < frames[0] else []
    for key in sorted(before.keys() | after.keys()):
        old, new = (each[key] if key in each else default_of(config, key, "(not set)") for each in (before, after))
        follows = key.endswith(FOLLOWS) and (old, new) == frames
        if old != new and not follows:
            changed.append(f"{key}: {old} -> {new}")
    return changed


def _without_copies(settings: dict[str, Any]) -> dict[str, Any]:
    """Leaves out what loggers are only given to show: it is stored elsewhere as well."""
    loggers = (settings.get("logger") or {}).get("loggers")
    for logger in loggers if isinstance(loggers, list) else []:
        if isinstance(logger, dict):
            logger.pop("settings", None)
    return settings
