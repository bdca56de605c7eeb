"""Where a training starts: anew in its own folder, or where an earlier one stopped."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path

import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.types import RunMode

from hdrqn_torchrl.cli.changed_settings import differences, with_overrides
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.commands import command_of
from hdrqn_torchrl.runs.settings.reading import read_choices, read_config
from hdrqn_torchrl.runs.settings.run_settings import RunSettings, as_plain, check
from hdrqn_torchrl.runs.settings.stored_settings import INTERPOLATION


@dataclass(frozen=True)
class Plan:
    """What a training is going to do."""

    folder: Path
    config: RunSettings
    choices: dict[str, str]
    resumed: bool
    """Whether it goes on with a run that was begun before."""
    checkpoint: Path | None = None
    """Where it goes on; ``None``: at the run's newest checkpoint."""
    weights: Path | None = None
    """What it begins with instead of random weights."""
    label: str = ""
    """Names it among others that share this process, whose progress bars would overwrite each other."""


def plan(config: RunSettings, folder: Path) -> Plan:
    """Follows ``resume``.

    Args:
        config: settings of the command line (:func:`~hdrqn_torchrl.cli.configuration.resolved`).
        folder: Hydra's new run folder.

    Raises:
        SettingsError: if a run would be overwritten, or resumed with other settings.
    """
    choices = dict(HydraConfig.get().runtime.choices)
    refuse_other_algorithm(choices)
    if config.resume is None:
        refuse_reference(folder)
        refuse_occupied(folder, config)
        return Plan(folder, config, choices, resumed=False)
    if config.resume == "auto":
        run, checkpoint = find_same(config, folder), None
        if run is None:
            return Plan(folder, config, choices, resumed=False)
    else:
        run, checkpoint = layout.split(Path(config.resume))
        known = {f"sqlite:///{root}/mlflow.db" for root in (config.output_root, run.parent.parent)}
        config = with_overrides(read_config(run), read_choices(run), config, HydraConfig.get().overrides.task)
        check(config)
        refuse_other_databases(config, known)
    refuse_differences(run, config)
    if checkpoint is not None and not config.resume_override:
        refuse_going_back(checkpoint)
    if run.resolve() != folder.resolve():
        with contextlib.suppress(OSError):  # Hydra made it for this process; it is empty
            folder.rmdir()
            folder.parent.rmdir()
    return Plan(run, config, read_choices(run) or choices, resumed=True, checkpoint=checkpoint)


def with_groups_of_run(arguments: Sequence[str]) -> list[str]:
    """Names the groups that a resumed run was composed of, where the command changes settings of theirs.

    ``resume=FOLDER algo.sub_gamma=0.8`` then means the run's algorithm, and not the default one.
    """
    values = dict(argument.lstrip("+~").split("=", 1) for argument in arguments if "=" in argument)
    run = values.get("resume", "auto").strip("'\"")
    if run in ("auto", "null"):
        return list(arguments)
    choices = read_choices(layout.split(Path(run))[0])
    changed = {key.partition(".")[0] for key in values if "." in key} - values.keys()
    named = [f"{group}={choices[group]}" for group in sorted(changed & choices.keys())]
    return [*arguments, *(each for each in named if re.fullmatch(r"\w+=[\w-]+", each))]  # a run folder may be anyone's


def refuse_reference(folder: Path) -> None:
    """Ends the program if a new run could not be named afterwards."""
    if INTERPOLATION in os.path.relpath(folder):
        raise SettingsError(
            f"hydra.run.dir must be a folder without {INTERPOLATION} in its name, got {folder}; that is how references "
            "begin, so nothing could name it afterwards."
        )


def refuse_other_algorithm(choices: dict[str, str]) -> None:
    """Ends the program if a variant of one algorithm was given with another one.

    Args:
        choices: files of conf/ by group.
    """
    variant = choices.get("variant")
    for source in HydraConfig.get().runtime.config_sources if variant else ():
        path = Path(source.path) / "variant" / f"{variant}.yaml"
        if source.schema == "file" and path.is_file():
            defaults = yaml.safe_load(path.read_text()).get("defaults", ())
            own = [each["override /algo"] for each in defaults if isinstance(each, dict) and "override /algo" in each]
            if own and own[0] != choices["algo"]:
                raise SettingsError(
                    f"variant={variant} must be given with its own algorithm, {own[0]}, got algo={choices['algo']}; "
                    "leave algo out."
                )


def command(folder: Path, allowed_targets: Sequence[str] = ()) -> str:
    """The command that resumes a run, quoted for the shell and for Hydra, with the targets that it must allow."""
    value = str(folder)
    if INTERPOLATION in value:
        value = os.path.relpath(folder)
    if value == "auto":
        value = "./auto"
    words = [f"resume={_quoted(value)}"]
    if allowed_targets:
        words.append(f"allowed_targets=[{','.join(map(_quoted, allowed_targets))}]")
    return f"{command_of('train')} {shlex.join(words)}"


def _quoted(value: str) -> str:
    """A value as Hydra reads it as plain text: in quotes if it is one like ``null``, ``007`` or ``a,b``."""
    try:
        if OverridesParser.create().parse_override(f"resume={value}").value() == value:
            return value
    except HydraException:
        pass
    return '"' + value.replace('"', '\\"') + '"'


def find_same(config: RunSettings, folder: Path) -> Path | None:
    """The run that the same command started before: in ``folder``, or else below ``output_root``.

    There one that has checkpoints is preferred, then one of as many frames, then the newest.
    """
    if (folder / layout.CONFIG).exists():
        return folder
    if any(override.startswith(("hydra.run", "hydra.sweep")) for override in HydraConfig.get().overrides.hydra):
        return None
    runs = [path.parent for path in Path(config.output_root).glob("*/*/config.yaml")]
    siblings = folder.resolve().parent if HydraConfig.get().mode == RunMode.MULTIRUN else None  # other jobs' runs
    same = [run for run in runs if run.resolve().parent != siblings and not _differences_or_broken(run, config)]

    def fits(run: Path) -> tuple[bool, bool, float]:
        exact = read_config(run).total_frames == config.total_frames
        return (run / layout.CHECKPOINTS).is_dir(), exact, (run / layout.CONFIG).stat().st_mtime

    return max(same, key=fits, default=None)


def _differences_or_broken(run: Path, config: RunSettings) -> list[str]:
    try:
        return differences(as_plain(read_config(run)), as_plain(config))
    except SettingsError as error:
        return [str(error)]


def refuse_differences(run: Path, config: RunSettings) -> None:
    """Ends the program with a list of what changed since ``run`` began, unless ``resume_override`` is set."""
    found = differences(as_plain(read_config(run)), as_plain(config))
    if found and not config.resume_override:
        lines = "\n  ".join(found)
        raise SettingsError(
            f"settings must be those of the run that is resumed, and differ from {run}:\n  {lines}\n"
            "Leave them out, or take the new ones with resume_override=true."
        )


def refuse_other_databases(config: RunSettings, known: Set[str]) -> None:
    """Ends the program if a run folder names a database or server that the command does not: it would be written to.

    Args:
        config: settings of a run that was read back.
        known: those that may be written to without asking.
    """
    for index, logger in enumerate(config.logger["loggers"]):
        place = logger.get("tracking_uri")
        if place is not None and place not in {*known, *config.allowed_targets}:
            allowed = shlex.quote(f"allowed_targets=[{_quoted(str(place))}]")
            raise SettingsError(
                f"logger.loggers[{index}].tracking_uri must be one of {', '.join(sorted(known))}, got {place!r}, which "
                f"stands in the run folder. If it is yours, add {allowed} to the command."
            )


def refuse_occupied(folder: Path, config: RunSettings) -> None:
    """Ends the program if there is a run in the folder of a new one, or something else that has its files' names."""
    if layout.holds_run(folder):
        raise SettingsError(
            f"{folder} already holds a run, which would be overwritten; "
            f"`{command(folder, config.allowed_targets)}` goes on, any other hydra.run.dir begins a new one."
        )
    if found := [name for name in layout.WRITTEN if name != layout.ERROR and (folder / name).exists()]:
        raise SettingsError(
            f"{folder} holds no run, but {', '.join(found)}, which would be overwritten; name another hydra.run.dir."
        )


def refuse_overwriting(run: Plan) -> None:
    """Ends the program if a run without checkpoints, which can only begin anew, has results or weights to lose."""
    remedies = {
        layout.SUMMARY: "Begin a new run in another folder",
        layout.WEIGHTS: f"Begin a new run with its weights by init_from={run.folder}",
        layout.METRICS: "Begin a new run in another folder",
    }
    for name, remedy in remedies.items():
        lost = (run.folder / name).exists() and (name != layout.METRICS or _had_checkpoints(run))
        if lost and not run.config.resume_override:
            raise SettingsError(
                f"resume must name a run that has checkpoints, got {run.folder}, which has none: it would begin anew, "
                f"and its {name} would be void. {remedy}, or allow it with resume_override=true."
            )


def _had_checkpoints(run: Plan) -> bool:
    """Whether a run has measured more than there is before its first checkpoint."""
    from hdrqn_torchrl.analysis.results import read_metrics

    frames = read_metrics(run.folder / layout.METRICS).get("frames", [0])
    return max(frames, default=0) > run.config.checkpoint.interval_frames + run.config.log_frames


def refuse_going_back(checkpoint: Path) -> None:
    """Ends the program if a run was saved later than ``checkpoint``: going on from there would undo that."""
    if later := sorted(path.name for path in checkpoint.parent.glob("checkpoint-*") if path.name > checkpoint.name):
        raise SettingsError(
            f"resume must name a run's newest checkpoint, got {checkpoint}; {', '.join(later)} and the rows logged "
            "since would be removed. Copy the run folder and resume the copy, or allow it with resume_override=true."
        )
