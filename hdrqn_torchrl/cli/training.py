"""One training by its settings: everything is built, begun or gone on with, trained, and summed up.

It needs all that trainings need, which takes seconds to load; the programs load it when they begin one.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import CheckpointError
from torchrl.envs import EnvBase

from hdrqn_torchrl.algorithms import Algorithm
from hdrqn_torchrl.analysis.results import read_metrics
from hdrqn_torchrl.cli import sweeps
from hdrqn_torchrl.cli.command_line import print_result
from hdrqn_torchrl.cli.failures import in_words, noting_errors
from hdrqn_torchrl.cli.origin import record
from hdrqn_torchrl.cli.resuming import Plan, refuse_occupied, refuse_overwriting
from hdrqn_torchrl.devices import set_deterministic
from hdrqn_torchrl.envs import task_of
from hdrqn_torchrl.envs.specs import interface_differences
from hdrqn_torchrl.random_numbers import seed_all
from hdrqn_torchrl.runs.collectors.making import make_collector
from hdrqn_torchrl.runs.evaluation import evaluate
from hdrqn_torchrl.runs.facts import check_facts, facts_of, write_facts
from hdrqn_torchrl.runs.interruption import StopRequest
from hdrqn_torchrl.runs.logging import RunLogger
from hdrqn_torchrl.runs.persistence import folder, layout
from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints
from hdrqn_torchrl.runs.persistence.files import check_file, remove, replaced
from hdrqn_torchrl.runs.persistence.transfer import find_weights, load_weights_of, start_from
from hdrqn_torchrl.runs.references import Players
from hdrqn_torchrl.runs.settings.building import build, build_algorithm, build_evaluation_env
from hdrqn_torchrl.runs.settings.run_settings import pick_device
from hdrqn_torchrl.runs.trainer import Trainer


def pieces(run: Plan, stop: StopRequest) -> Generator[None, None, float]:
    """:func:`train` in pieces, between which other trainings of this process may have their turns."""
    patience = sweeps.PATIENCE_SECONDS if sweeps.is_sweep() else 0.0
    with in_words(run), folder.locked(run.folder, patience_seconds=patience, tell=tell):
        refused = (ValueError, CheckpointError) if run.resumed else ()
        with noting_errors(run, unless=refused):
            trainer, evaluation_env, players = begin(run, stop)
        yield
        with noting_errors(run):
            try:
                with in_words(run, trainer=trainer):
                    yield from trainer.pieces()
            finally:
                trainer.collector.shutdown()
            return write_summary(run, trainer, evaluation_env, players)["return_mean"]


def tell(sentence: str) -> None:
    """Announces slow work on the terminal."""
    print(sentence, file=sys.stderr, flush=True)


def late_learners(algorithm: Algorithm, total_frames: int) -> list[str]:
    """A warning for each learner that a large part of a training is over for before it begins, or all of it."""
    found = []
    for name, learner in algorithm.learners.items():
        warmup, first = learner.settings.warmup_frames, learner.first_update_at
        if total_frames <= warmup:
            found.append(
                f"warning: total_frames={total_frames:,} must be above warmup_frames={warmup:,} for the learner "
                f"{name!r} to learn anything; use more frames or a shorter warmup"
            )
        elif first > warmup and first > total_frames / 4:
            found.append(
                f"warning: env.num_envs should be smaller for total_frames={total_frames:,}, as the learner {name!r} "
                f"learns nothing in the first {first:,} frames, in which all worlds play their first sequence; use "
                "fewer worlds or more frames"
            )
    return found


def tell_of_player(sentence: str) -> None:
    """The same for scripted players, which can be done without."""
    tell(f"{sentence}; evaluation.ceilings=false leaves that out")


def begin(run: Plan, stop: StopRequest | None = None) -> tuple[Trainer, EnvBase, Players]:
    """Builds what a run needs (:func:`build_run`), where it begins or where it goes on; clears what is out of date."""
    for name in layout.WRITTEN:
        check_file(run.folder / name)
    if not run.resumed:
        refuse_occupied(run.folder, run.config)  # again: another process may have begun one since this was planned
    checkpoints = Checkpoints(run.folder / layout.CHECKPOINTS)
    checkpoints.clean_up()  # first: it may bring back the newest
    start = run.checkpoint or (checkpoints.newest() if run.resumed else None)
    if run.resumed and start is None:
        refuse_overwriting(run)
        tell(f"{run.folder} has no checkpoint to go on from: it begins anew")
    own = {Path(name).stem for name in layout.WRITTEN}
    stale = [path for path in run.folder.glob("*.partial*") if path.name.partition(".")[0] in own]
    for path in [*stale, *([run.folder / layout.METRICS] if start is None else [])]:
        remove(path)
    trainer, evaluation_env, players = build_run(run, stop)
    facts = facts_of(trainer.collector.env.base_env)
    if start is not None:
        if not run.config.resume_override:
            check_facts(run.folder, facts)
        trainer.resume(start)
    elif run.config.init_from is not None:
        path = find_weights(Path(run.config.init_from), run.config.init_checkpoint)
        start_from(trainer.algorithm, load_weights_of(path))
        trainer.collector.update_policy_weights_()
        run = replace(run, weights=path)
    record(run)  # only now: settings that the checkpoint does not fit must not replace those of the run
    write_facts(run.folder, facts)
    for name in layout.AT_THE_END if trainer.frames < trainer.total_frames else (layout.ERROR,):
        remove(run.folder / name)
    return trainer, evaluation_env, players


def write_summary(run: Plan, trainer: Trainer, evaluation_env: EnvBase, players: Players) -> dict[str, Any]:
    """Final greedy evaluation; writes and prints the run's results."""
    from hdrqn_torchrl.analysis.plotting import plot_run  # matplotlib is needed only now

    result = evaluate(
        evaluation_env,
        trainer.algorithm.policy,
        episodes=run.config.evaluation.final_episodes,
        seed=run.config.evaluation.seed + 1,
        max_steps=run.config.evaluation.max_steps,
    )
    summary = folder.write_summary(run.folder, trainer, result, ceiling=trainer.ceiling())
    references = players()  # all of them only now: neither training nor its result need wait
    with replaced(run.folder / layout.CURVES) as picture:
        plot_run(read_metrics(run.folder / layout.METRICS), picture, title=title_of(run), references=references)
    print_result(json.dumps({"run": str(run.folder), **summary}))
    return summary


def title_of(run: Plan) -> str:
    """What a run was composed from, with the id of its task, for its figure."""
    groups = {name: f"{name}={run.choices[name]}" for name in ("env", "algo", "network") if name in run.choices}
    id = run.config.env.get("id")
    return " ".join([*groups.values(), *([] if id is None else [f"id={id}"]), f"seed={run.config.seed}"])


def build_run(run: Plan, stop: StopRequest | None = None) -> tuple[Trainer, EnvBase, Players]:
    """Everything that a run needs: trainer, evaluation environment, and what finds the scripted players' figures."""
    config, stop = run.config, stop or StopRequest()
    device = pick_device(config.device, torch.cuda.is_available())
    set_deterministic(config.deterministic, device)
    seed_all(config.seed)
    allowed = config.allowed_targets
    env, algorithm = build_algorithm(config, {"seed": config.seed, "device": device}, allowed)
    played = {"num_envs": config.evaluation.num_envs, "device": device}
    evaluation_base = build_evaluation_env(config, played, allowed)
    if found := interface_differences(env, evaluation_base):
        raise ValueError(
            f"evaluation.env must not change what the agent sees or does, got "
            f"{config.evaluation.env}: {found}; set env.KEY for both."
        )
    for sentence in late_learners(algorithm, config.total_frames):
        tell(sentence)
    evaluation_env = algorithm.transform(evaluation_base)
    chosen = config.evaluation
    players = Players(
        task_of(evaluation_base), play=chosen.ceilings, seconds=chosen.ceiling_seconds, tell=tell_of_player
    )
    collector = make_collector(
        config,
        env,
        algorithm,
        device=device,
        allowed=allowed,
    )
    trainer = Trainer(
        algorithm,
        collector,
        logger=RunLogger(
            run.folder,
            total_frames=config.total_frames,
            loggers=[
                build(logger, run.folder, place=f"logger.loggers[{index}]", allowed=allowed)
                for index, logger in enumerate(config.logger["loggers"])
            ],
            label=run.label or (run.folder.name if sweeps.is_sweep() else ""),
            bar=not run.label,
        ),
        evaluate=lambda: evaluate(
            evaluation_env,
            algorithm.policy,
            episodes=config.evaluation.episodes,
            seed=config.evaluation.seed,
            max_steps=config.evaluation.max_steps,
            check=stop.check,
        ),
        total_frames=config.total_frames,
        log_frames=config.log_frames,
        evaluation_frames=config.evaluation.interval_frames,
        checkpoints=Checkpoints(
            run.folder / layout.CHECKPOINTS, keep_last=config.checkpoint.keep_last, replay=config.checkpoint.replay
        ),
        checkpoint_frames=config.checkpoint.interval_frames,
        checkpoint_seconds=60.0 * config.checkpoint.interval_minutes,
        ceiling=players.ceiling,
        stop=stop,
    )
    return trainer, evaluation_env, players
