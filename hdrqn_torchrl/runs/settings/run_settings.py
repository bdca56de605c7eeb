"""Settings of a run as plain data, and their rules; what builds from them stands in building.py."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from functools import cache
from typing import Any, get_type_hints

from hdrqn_torchrl.runs.settings.arguments import Settings, SettingsError, fits, in_words, remedy, shown
from hdrqn_torchrl.runs.settings.seeds import LARGEST_SEED, check_together
from hdrqn_torchrl.runs.settings.trust import check_targets


@dataclass(kw_only=True)
class EvaluationSettings:
    """Greedy evaluation."""

    num_envs: int
    episodes: int
    interval_frames: int
    final_episodes: int
    seed: int
    ceilings: bool = True
    ceiling_seconds: float = 120.0  # for each scripted player
    max_steps: int | None = None
    """Of an episode."""
    env: dict[str, Any] = field(default_factory=dict)
    """Settings of the environment that differ in evaluations."""


@dataclass(kw_only=True)
class CheckpointSettings:
    """When the whole training is saved."""

    interval_frames: int
    interval_minutes: float
    keep_last: int
    replay: Any = True
    """Or ``False``, or ``"last"``."""


@dataclass(kw_only=True)
class CollectorSettings:
    """Who collects."""

    kind: str = "local"
    """This process; or workers: ``"processes"`` of this machine, or ``"ray"``."""
    workers: int = 1
    sync: bool = True
    """Whether workers wait for new weights; ``False``: theirs are one batch old."""
    address: str | None = None
    """Of a running Ray cluster; ``None``: one is started on this machine."""
    patience_seconds: float = 300.0
    """After which a worker that does not answer is replaced."""


@dataclass(kw_only=True)
class RunSettings:
    """All settings of a run; a key that is not here is refused. Defaults are for runs older than the setting."""

    env: dict[str, Any]
    algo: dict[str, Any]
    network: dict[str, Any]
    logger: dict[str, Any]
    seed: int
    seeds: Any = None
    """Of several trainings in one process: ``"0..9"`` or ``[0, 1, 2]``; the settings of each have ``None``."""
    device: str
    threads: int
    precision: str = "fp32"
    capture: Any = "auto"
    """Or ``True``, or ``False``."""
    batch_scale: int = 1
    """Of all learners (:class:`~hdrqn_torchrl.learning.LearnerSettings`)."""
    deterministic: bool = False
    """Whether a GPU repeats its numbers bit for bit."""
    total_frames: int
    steps_per_batch: int
    log_frames: int
    evaluation: EvaluationSettings
    checkpoint: CheckpointSettings
    collector: CollectorSettings = field(default_factory=CollectorSettings)
    output_root: str
    init_from: str | None = None
    init_checkpoint: str = "best"
    resume: str | None
    resume_override: bool
    allowed_targets: list[str] = field(default_factory=list)


SECTIONS: dict[str, type] = {
    "evaluation": EvaluationSettings,
    "checkpoint": CheckpointSettings,
    "collector": CollectorSettings,
}
_COLLECTORS = ("local", "processes", "ray")
_LIMITS = (
    ("total_frames", 1, 10**15),
    ("threads", 1, 1_024),
    ("steps_per_batch", 2, 100_000),  # TorchRL's two-dimensional storage can't take single steps
    ("log_frames", 1, 10**15),
    ("batch_scale", 1, 10_000),
    ("seed", 0, LARGEST_SEED),
    ("evaluation.num_envs", 1, 100_000),
    ("evaluation.episodes", 1, 10**9),
    ("evaluation.interval_frames", 1, 10**15),
    ("evaluation.final_episodes", 1, 10**9),
    ("evaluation.seed", 0, LARGEST_SEED),
    ("checkpoint.interval_frames", 1, 10**15),
    ("collector.workers", 1, 10_000),
    ("checkpoint.keep_last", 2, 1_000),  # so that there is one while the newest is being replaced
)


def settings_of(data: Mapping[str, Any]) -> RunSettings:
    """The settings of a run from plain nested dicts.

    Raises:
        SettingsError: naming the first setting that is unknown, missing or of another type.
    """
    sections = {
        name: _typed(kind, data[name], f"{name}.")
        for name, kind in SECTIONS.items()
        if isinstance(data.get(name), dict)
    }
    return _typed(RunSettings, {**data, **sections})


def as_plain(settings: RunSettings) -> Settings:
    """The plain nested dicts that :func:`settings_of` reads."""
    return asdict(settings)


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _typed(kind: type, data: Mapping[str, Any], prefix: str = "") -> Any:
    hints = _hints(kind)
    if unknown := set(data) - set(hints):
        raise SettingsError(f"{min(map(str, unknown))} must be a known setting; {remedy()}.")
    for each in fields(kind):
        full, hint = f"{prefix}{each.name}", hints[each.name]
        if each.name not in data:
            if each.default is MISSING and each.default_factory is MISSING:
                raise SettingsError(f"{full} must be given, got nothing; {remedy()}.")
        elif not fits(data[each.name], hint):
            kinds = "settings by name" if full in SECTIONS else in_words(hint)
            raise SettingsError(f"{full} must be {kinds}, got {shown(data[each.name])}; {remedy()}.")
    return kind(**data)


def check(settings: RunSettings) -> None:
    """Refuses what would fail only in the middle of a run, and what may not be built.

    Raises:
        SettingsError: naming setting, rule and value.
    """
    for key, least, most in _LIMITS:
        section, _, name = key.rpartition(".")
        value = getattr(getattr(settings, section) if section else settings, name)
        if value < least:
            raise SettingsError(f"{key} must be >= {least}, got {value}; leave it out for the default.")
        if value > most:
            raise SettingsError(f"{key} must be <= {most:,}, got {str(value)[:25]}; leave it out for the default.")
    longest = settings.evaluation.max_steps
    if longest is not None and longest < 1:
        raise SettingsError(
            f"evaluation.max_steps must be >= 1 or null, got {longest}; null plays episodes to their end."
        )
    minutes = settings.checkpoint.interval_minutes
    if minutes <= 0:
        raise SettingsError(f"checkpoint.interval_minutes must be > 0, got {minutes}; use 10.")
    _check_collector(settings.collector)
    _check_choices(settings)
    check_targets(as_plain(settings), settings.allowed_targets)


def _check_collector(collector: CollectorSettings) -> None:
    kind = collector.kind
    if kind not in _COLLECTORS:
        raise SettingsError(f"collector.kind must be one of {', '.join(_COLLECTORS)}, got {kind!r}; use collector=ray.")
    if kind == "local" and (collector.workers != 1 or not collector.sync):
        got = f"workers={collector.workers}, sync={shown(collector.sync)}"
        raise SettingsError(
            f"collector.workers and collector.sync must be 1 and true for collector=local, got {got}; use "
            "collector=processes or collector=ray."
        )
    if collector.address is not None and kind != "ray":
        raise SettingsError(
            f"collector.address must be null for collector={kind}, got {collector.address!r}; use collector=ray."
        )
    if collector.patience_seconds <= 0:
        raise SettingsError(f"collector.patience_seconds must be > 0, got {collector.patience_seconds}; use 300.")


def _check_choices(settings: RunSettings) -> None:
    if settings.seeds is not None:
        check_together(settings.seeds, settings.logger, settings.resume)
    if settings.device not in ("auto", "cpu", "cuda"):
        raise SettingsError(
            f"device must be auto, cpu or cuda, got {settings.device!r}; auto takes a GPU if there is one."
        )
    if settings.capture not in ("auto", True, False):
        raise SettingsError(
            f"capture must be auto, true or false, got {shown(settings.capture)}; auto captures on a GPU."
        )
    if settings.init_checkpoint not in ("best", "last"):
        raise SettingsError(
            f"init_checkpoint must be best or last, got {settings.init_checkpoint!r}; init_from=CHECKPOINT names any "
            "other."
        )
    replay = settings.checkpoint.replay
    if replay not in (True, False, "last"):
        raise SettingsError(
            f"checkpoint.replay must be true, false or last, got {shown(replay)}; true goes on exactly."
        )
    loggers = settings.logger.get("loggers")
    if not isinstance(loggers, list):
        raise SettingsError(f"logger.loggers must be a list, got {shown(loggers)}; [] writes metrics.csv alone.")


def pick_device(name: str, has_cuda: bool) -> str:
    """``auto`` is the GPU where there is one."""
    if name == "cuda" and not has_cuda:
        raise SettingsError(
            "device must be cpu or auto on a machine without a usable GPU, got 'cuda'; use device=auto."
        )
    return ("cuda" if has_cuda else "cpu") if name == "auto" else name
