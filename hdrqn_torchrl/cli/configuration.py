"""Settings and their rules; runs read back; the command line of the programs that look at runs.

Beside the entry points only this file, building.py, resuming.py, sweeps.py and studies.py know hydra and omegaconf.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

from hydra.core.config_store import ConfigStore
from hydra.errors import InstantiationException
from omegaconf import MISSING, DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

import hdrqn_torchrl
from hdrqn_torchrl.cli.arguments import remedy, shown
from hdrqn_torchrl.cli.building import SettingsError, build_algorithm, build_env, check_targets, explain, plain
from hdrqn_torchrl.runs.commands import as_called
from hdrqn_torchrl.runs.files import RunFileError, read_json
from hdrqn_torchrl.runs.stored_settings import read_settings

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from hdrqn_torchrl.algorithms import Algorithm


@dataclass
class EvaluationSchema:
    """Greedy evaluation."""

    num_envs: int = MISSING
    episodes: int = MISSING
    interval_frames: int = MISSING
    final_episodes: int = MISSING
    seed: int = MISSING
    ceilings: bool = True
    max_steps: int | None = None  # of an episode
    env: dict[str, Any] = field(default_factory=dict)  # settings of the environment that differ in evaluations


@dataclass
class CheckpointSchema:
    """When the whole training is saved."""

    interval_frames: int = MISSING
    interval_minutes: float = MISSING
    keep_last: int = MISSING
    replay: Any = True  # or False, or "last"


@dataclass
class Schema:
    """Top-level settings and their types; a key that is not here is refused."""

    env: Any = MISSING
    algo: Any = MISSING
    network: Any = MISSING
    logger: Any = MISSING
    seed: int = MISSING
    device: str = MISSING
    threads: int = MISSING
    precision: str = "fp32"  # of runs that are older than this setting
    total_frames: int = MISSING
    steps_per_batch: int = MISSING
    log_frames: int = MISSING
    evaluation: EvaluationSchema = field(default_factory=EvaluationSchema)
    checkpoint: CheckpointSchema = field(default_factory=CheckpointSchema)
    output_root: str = MISSING
    init_from: str | None = None
    init_checkpoint: str = "best"
    resume: str | None = MISSING
    resume_override: bool = MISSING
    allowed_targets: list[str] = field(default_factory=list)


ConfigStore.instance().store(name="schema", node=Schema)
PARTS = ("env", "algo", "network", "logger")
_PACKAGE = Path(hdrqn_torchrl.__file__).parent
CONF = next(folder for folder in (_PACKAGE / "conf", _PACKAGE.parent / "conf") if (folder / "config.yaml").exists())
"""The configuration files: inside an installed package, or beside it in a checkout."""


class RunError(RuntimeError):
    """A training that could not go on, in words for its user."""


def resolved(config: DictConfig) -> DictConfig:
    """Settings as one's own command line composed them, with every reference followed, once: values from here on.

    Raises:
        SettingsError: if a reference leads nowhere, or a value is missing or of another type.
    """
    try:
        values = OmegaConf.merge(OmegaConf.structured(Schema), plain(config))
    except (OmegaConfBaseException, RecursionError) as error:
        raise SettingsError((str(error) or "settings must not refer to themselves").splitlines()[0]) from error
    assert isinstance(values, DictConfig)
    return values


def check(config: DictConfig) -> None:
    """Refuses keys that nothing reads and numbers that would fail only in the middle of a run."""
    for section, schema in (
        (config, Schema),
        (config.evaluation, EvaluationSchema),
        (config.checkpoint, CheckpointSchema),
    ):
        if unknown := set(section) - {known.name for known in fields(schema)}:  # added with +
            raise SettingsError(f"{min(unknown)} must be a known setting; {remedy()}.")
    for key, least, most in (
        ("total_frames", 1, 10**15),
        ("threads", 1, 1_024),
        ("steps_per_batch", 2, 100_000),  # TorchRL's two-dimensional storage can't take single steps
        ("log_frames", 1, 10**15),
        ("seed", 0, 2**62),
        ("evaluation.num_envs", 1, 100_000),
        ("evaluation.episodes", 1, 10**9),
        ("evaluation.interval_frames", 1, 10**15),
        ("evaluation.final_episodes", 1, 10**9),
        ("evaluation.seed", 0, 2**62),
        ("checkpoint.interval_frames", 1, 10**15),
        ("checkpoint.keep_last", 2, 1_000),  # so that there is one while the newest is being replaced
    ):
        value = OmegaConf.select(config, key)
        if value < least:
            raise SettingsError(f"{key} must be >= {least}, got {value}; leave it out for the default.")
        if value > most:
            raise SettingsError(f"{key} must be <= {most:,}, got {str(value)[:25]}; leave it out for the default.")
    longest = config.evaluation.max_steps
    if longest is not None and longest < 1:
        raise SettingsError(
            f"evaluation.max_steps must be >= 1 or null, got {longest}; null plays episodes to their end."
        )
    if config.checkpoint.interval_minutes <= 0:
        raise SettingsError(
            f"checkpoint.interval_minutes must be > 0, got {config.checkpoint.interval_minutes}; use 10."
        )
    if config.device not in ("auto", "cpu", "cuda"):
        raise SettingsError(
            f"device must be auto, cpu or cuda, got {config.device!r}; auto takes a GPU if there is one."
        )
    which = config.init_checkpoint
    if which not in ("best", "last"):
        raise SettingsError(
            f"init_checkpoint must be best or last, got {which!r}; init_from=CHECKPOINT names any other."
        )
    replay = config.checkpoint.replay
    if replay not in (True, False, "last"):
        raise SettingsError(
            f"checkpoint.replay must be true, false or last, got {shown(replay)}; true goes on exactly."
        )
    loggers = OmegaConf.select(config, "logger.loggers")
    if not isinstance(loggers, ListConfig):
        raise SettingsError(f"logger.loggers must be a list, got {shown(loggers)}; [] writes metrics.csv alone.")
    check_targets(plain(config), config.allowed_targets)


def pick_device(name: str, has_cuda: bool) -> str:
    """``auto`` is the GPU where there is one."""
    if name == "cuda" and not has_cuda:
        raise SettingsError(
            "device must be cpu or auto on a machine without a usable GPU, got 'cuda'; use device=auto."
        )
    return ("cuda" if has_cuda else "cpu") if name == "auto" else name


def read_config(folder: Path) -> DictConfig:
    """``config.yaml`` of a run folder. Nothing in it is trusted: see building.py."""
    path = folder / "config.yaml"
    if not path.is_file():
        raise SettingsError(
            f"run must be the folder of a training, got {folder}, which has no config.yaml; "
            "the default place of runs is outputs/."
        )
    try:
        config = OmegaConf.merge(OmegaConf.structured(Schema), OmegaConf.create(read_settings(path)))
        assert isinstance(config, DictConfig)
        OmegaConf.to_container(config, throw_on_missing=True)
        if not all(isinstance(config[part], DictConfig) for part in PARTS):
            raise TypeError(f"{', '.join(PARTS)} must have settings below them")
    except RunFileError as error:
        raise SettingsError(str(error)) from error
    except (OmegaConfBaseException, OSError, ValueError, TypeError, AssertionError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise SettingsError(f"{path} can't be read as the settings of a run: {reason}.") from error
    assert isinstance(config, DictConfig)
    return config


def read_choices(folder: Path) -> dict[str, str]:
    """Which file of each group of conf/ a run was composed of (``{"env": "gridworld", "algo": "v2", ...}``)."""
    try:
        choices = read_json(folder / "run.json")["choices"]
        return {str(group): str(choice) for group, choice in choices.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}  # it is for headings and comparisons only


@dataclass(frozen=True)
class Agent:
    """A trained agent read back from its run folder."""

    config: DictConfig
    env: EnvBase
    """Transformed environment with batch size ``[num_envs]``."""
    algorithm: Algorithm


def load_agent(
    run: str | Path,
    *,
    checkpoint: str = "best",
    num_envs: int = 1,
    env_changes: dict[str, Any] | None = None,
    allowed_targets: list[str] | None = None,
) -> Agent:
    """Builds a run's agent on its task and loads its weights.

    Args:
        run: run folder.
        checkpoint: ``"best"``, ``"last"``, or the path of a checkpoint or weights file.
        num_envs: number of worlds of the environment.
        env_changes: settings of the environment that shall differ from the run's.
        allowed_targets: see :func:`building.build`.

    Raises:
        SettingsError: if the folder is not a run, names something that may not be built, or its weights do not fit.
    """
    from hdrqn_torchrl.runs.checkpoint import load_policy

    folder = Path(run)
    config = read_config(folder)
    changes = {**plain(config.evaluation.env), **(env_changes or {})}
    for key in changes:
        if key.startswith("_") or key not in config.env:
            raise SettingsError(f"env.{key} must be one of {sorted(set(config.env) - {'_target_'})}; it is none.")
    own, allowed = config.copy(), allowed_targets or []
    config.env = plain(config.env) | changes
    try:
        env, algorithm = build_algorithm(config, {"num_envs": num_envs, "device": "cpu"}, allowed)
        try:
            load_policy(algorithm.policy, folder / "checkpoints", checkpoint)
        except ValueError:
            if changes:
                refuse_other_interface(build_env(own, {"num_envs": 1, "device": "cpu"}, allowed), env, changes)
            raise
    except (InstantiationException, ValueError) as error:
        raise SettingsError(explain(error)) from error
    return Agent(config, algorithm.transform(env), algorithm)


def refuse_other_interface(env: EnvBase, changed: EnvBase, changes: dict[str, Any]) -> None:
    """Says why an agent's networks don't fit a changed task, if that is the reason."""
    from hdrqn_torchrl.envs.specs import interface_differences

    if found := interface_differences(env, changed):
        given = " ".join(f"env.{key}={shown(value)}" for key, value in changes.items())
        raise SettingsError(
            f"{given} must leave what the agent sees and does as its networks were made for, but {found}; train an "
            "agent for that task."
        )


def check_place(path: Path, key: str) -> None:
    """Refuses a file that can't be written, before anything is done; makes its folder.

    Args:
        path: the file.
        key: the setting that names it.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        probe = path.with_name(f".{path.name}.partial")
        probe.touch()
        probe.unlink()
        if path.is_dir():
            raise IsADirectoryError("it is a folder")
    except OSError as error:
        raise SettingsError(f"{key} must be a file that can be written, got {str(path)!r} ({error}).") from error


def command_line(schema: type, doc: str, run: Callable[[Any], None]) -> None:
    """Calls ``run`` with an instance of ``schema`` filled from ``key=value`` arguments; ends with a message if wrong.

    Args:
        schema: dataclass of the settings; ``MISSING`` marks those that must be given.
        doc: what ``--help`` prints.
        run: does the work.
    """
    arguments = sys.argv[1:]
    if {"-h", "--help"} & set(arguments) or not arguments:
        print(as_called(doc.strip()))
        sys.exit(0 if arguments else 2)
    try:
        if wrong := [argument for argument in arguments if "=" not in argument]:
            raise SettingsError(f"an argument must read key=value, got {wrong[0]!r}; --help shows all of them.")
        pairs = [argument.split("=", 1) for argument in arguments]
        texts = {key: value for key, value in pairs if _is_text(schema, key, value)}
        read = [f"{key}={'text' if key in texts else value}" for key, value in pairs]
        try:
            settings = OmegaConf.merge(OmegaConf.structured(schema), OmegaConf.from_dotlist(read))
        except (OmegaConfBaseException, YAMLError) as error:
            known = ", ".join(each.name for each in fields(schema))
            raise SettingsError(f"{str(error).splitlines()[0]}; the settings are {known}.") from error
        if missing := OmegaConf.missing_keys(settings):
            raise SettingsError(f"{min(missing)} must be given: {min(missing)}=...; --help shows all settings.")
        run(replace(OmegaConf.to_object(settings), **texts))  # type: ignore[type-var]
    except SettingsError as error:
        sys.exit(f"error: {error}")


def _is_text(schema: type, key: str, value: str) -> bool:
    """Whether a value is meant as it stands, and not as YAML: ``#``, ``:``, ``*`` and ``null`` are parts of names, too.

    Settings of any type (``runs``, ``out``) take a text or a ``[list]``.
    """
    hint = get_type_hints(schema).get(key)
    if hint is Any:
        optional = getattr(schema, key, MISSING) != MISSING  # then it may be null
        return not (value.startswith("[") and value.endswith("]")) and not (optional and value == "null")
    return hint in (str, str | None)
