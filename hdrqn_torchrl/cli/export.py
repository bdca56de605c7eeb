"""Writes one greedy decision of a trained agent as a file that runs without this package, and checks it.

    python export.py run=RUN_DIR out=agent.onnx
    python export.py run=RUN_DIR out=agent.pt2

run             run folder
out             what to write, by ending: .onnx (needs the extra "export"; runs in onnxruntime, without PyTorch), or
                .pt2 (a program of torch.export, which needs PyTorch alone)
checkpoint      best (default), last, or the path of a checkpoint or weights file
episodes        greedy episodes in which the file is asked at every step and compared with the agent (default 10; 0:
                none)
seed            of their worlds (default 0)
allowed_targets builders of your own that the run may name: [package.builder]

The decision takes and returns tensors by name, for any number of worlds: what the environment shows (observation,
is_init; attained, available and others, as far as the agent reads them) and the state that the last decision returned.
docs/export.md explains each; examples/onnx_player.py plays such a file.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from omegaconf import MISSING

from hdrqn_torchrl.cli.command_line import check_place, command_line
from hdrqn_torchrl.runs.settings.arguments import SettingsError

LARGEST_DIFFERENCE = 1e-5
"""Of Q-values; sums in another order are in the range of 1e-6."""


@dataclass
class Settings:
    """Arguments; the module's docstring explains them."""

    run: str = MISSING
    out: str = MISSING
    checkpoint: str = "best"
    episodes: int = 10
    seed: int = 0
    allowed_targets: list[str] = field(default_factory=list)


def run(settings: Settings) -> None:
    """Writes the file, then plays beside it."""
    if settings.episodes < 0:
        raise SettingsError(f"episodes must be >= 0, got {settings.episodes}; 0 leaves the comparison out.")
    path = Path(settings.out)
    check_place(path, "out")
    # torch and torchrl take seconds to load; --help does without them.
    import torch

    from hdrqn_torchrl.export import DecisionStep, agreement_with, check_file, export_step, load_step
    from hdrqn_torchrl.runs import load_agent

    torch.set_num_threads(1)
    try:
        check_file(path)
        agent = load_agent(
            settings.run,
            checkpoint=settings.checkpoint,
            num_envs=max(settings.episodes, 1),
            allowed_targets=settings.allowed_targets,
        )
        step = DecisionStep(agent.algorithm, agent.env)
        export_step(step, path)
    except ValueError as error:
        raise SettingsError(str(error)) from error
    state = ", ".join(part.name for part in step.carried)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB, takes {', '.join(map(str, step.observed))}; state: {state}")
    if not settings.episodes:
        return
    limit = agent.config.evaluation.max_steps
    found = agreement_with(load_step(path), step, agent.env, seed=settings.seed, max_steps=limit)
    print(
        f"{found.episodes} episodes, {found.decisions} decisions: {found.other_actions} other actions than the "
        f"agent's, Q-values within {found.largest_difference:.1e}"
    )
    if found.largest_difference > LARGEST_DIFFERENCE:
        raise SettingsError(
            f"{path} differs by more than {LARGEST_DIFFERENCE:.0e} from the agent; use .pt2, whose numbers are the "
            "agent's own."
        )


def main() -> None:
    """Runs with the arguments of the command line."""
    command_line(Settings, __doc__ or "", run)
