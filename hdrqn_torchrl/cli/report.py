"""Writes the results of the paper's studies: figures, tables and a check of its claims, from run folders.

    python train.py -m experiment=gridworld sweep=parallel resume=auto output_root=outputs/studies
    python report.py runs=outputs/studies out=docs/results.md

runs      folders, glob patterns or archives (.tar.xz) that an earlier report kept, several in brackets; a run belongs
          to a study if it has the settings of one of its jobs, wherever it lies. Of several runs of one job the
          finished one that went furthest counts, of those that went as far the one in the place named last
out       text to write; its figures go to a folder of the same name. Whatever it holds outside the
          marked parts is left as it is
size      small (default) or paper: which of a study's two sizes
studies   only these: studies=gridworld,views; without it there is also an overview of all claims
keep      archive (.tar.xz) to put settings and measurements of the runs of all studies into, of either size; weights
          are not kept. If it is there already, runs must name it, too: runs of it that no study has now are named

The table of Montezuma's Revenge is made from what evaluate.py wrote into the run folders:
python evaluate.py run=RUN_DIR checkpoint=last episodes=100 num_envs=20 out=RUN_DIR/evaluations/greedy.json
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import MISSING
from PIL import Image

from hdrqn_torchrl.analysis.claims import Results
from hdrqn_torchrl.analysis.commits import commits_of, short_commit
from hdrqn_torchrl.analysis.comparison import plot_curves
from hdrqn_torchrl.analysis.estimates import Group, TaskResults, estimate_curves, estimate_finals
from hdrqn_torchrl.analysis.figures import plot_legs_over_time
from hdrqn_torchrl.analysis.grouping import value_of
from hdrqn_torchrl.analysis.results import AXES, final_value
from hdrqn_torchrl.cli.command_line import as_list, command_line
from hdrqn_torchrl.cli.entries import common_references, note, shortened
from hdrqn_torchrl.cli.marks import part_of, put
from hdrqn_torchrl.cli.studies import STUDIES, Drawing, Study
from hdrqn_torchrl.cli.study_runs import Found, Matched, Runs, check_archive, keep_runs, read_runs, runs_of_jobs
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.files import RunFileError, read_json, write_whole
from hdrqn_torchrl.runs.settings.arguments import SettingsError

SIZES = ("small", "paper")
QUANTITIES = ("return", "success", "in_order", "steps")
HEADER = (
    "| | seeds | return | 95 % interval | IQM | share of the ceiling | in order | all in order | steps | frames "
    "| {time} | commit |\n|---|---|---|---|---|---|---|---|---|---|---|---|"
)
SCREEN_HEADER = (
    "| | seed | trained frames | epsilon | sticky | score | 95 % interval over episodes | key | a door | steps "
    "| episodes | commit |\n|---|---|---|---|---|---|---|---|---|---|---|---|"
)
CLAIMS = "| claim (of greedy play at the end) | | measured |\n|---|---|---|"
_NAMES = [study.name for study in STUDIES]


@dataclass
class Settings:
    """Arguments; the module's docstring explains them."""

    runs: Any = MISSING
    out: str = "docs/results.md"
    size: str = "small"
    studies: Any = None
    keep: str | None = None


def run(settings: Settings) -> None:
    """Reads, matches, draws, writes."""
    wanted = [str(name) for name in as_list(settings.studies, split=True)] or _NAMES
    if settings.size not in SIZES:
        raise SettingsError(f"size must be one of {', '.join(SIZES)}, got {settings.size!r}.")
    if unknown := [name for name in wanted if name not in _NAMES]:
        raise SettingsError(f"studies must be some of {', '.join(_NAMES)}, got {unknown[0]!r}.")
    if Path(settings.out).suffix.lower() != ".md":
        raise SettingsError(f"out must end in .md, got {settings.out!r}; for example out=docs/results.md.")
    patterns = [str(each) for each in as_list(settings.runs)]
    if settings.keep:
        check_archive(settings.keep, patterns)
    out = Path(settings.out)
    figures = out.with_suffix("")
    try:
        figures.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(
            f"out must be a page whose figures can lie in a folder {figures}, got {settings.out!r} ({error})."
        ) from error
    left: list[str] = []
    parts: dict[str, str] = {}
    overview = [CLAIMS.replace("|", "| study |", 1).replace("|---", "|---|---", 1)]
    with ExitStack() as stack:
        runs = read_runs(patterns, stack)
        everywhere = runs_of_jobs("gridworld", settings.size, runs).runs
        for study in STUDIES:
            if study.name in wanted and settings.size in study.sizes:
                matched = runs_of_jobs(study.name, settings.size, runs)
                mark = f"{study.name} {settings.size}"
                if not matched.runs and "\n|" in part_of(_page(out), mark):
                    note(f"note: {study.name}: none of its runs is there, so its part of {out} stays as it is")
                    left.append(study.name)
                    continue
                part, claims = section(study, matched, everywhere, settings)
                parts[mark] = part
                overview += [f"| {study.title} {line}" for line in claims]
                print(f"{study.name}: runs {len(matched.runs)}, missing {matched.missing}")
                tell_of_others(study, matched)
        if left:
            note(f"note: the table of all claims in {out} stays as it is, too")
        elif not settings.studies:
            parts[f"claims {settings.size}"] = "\n".join(overview)
        if settings.keep:
            keep_runs(runs, Path(settings.keep))
    text = _page(out)  # only now: figures take a while, in which the author may write
    for mark, part in parts.items():
        text = put(text, mark, part)
    write_whole(out, text)


def _page(out: Path) -> str:
    return out.read_text() if out.exists() else "# Results\n"


def tell_of_others(study: Study, matched: Matched) -> None:
    """Names runs that would stand for a job if another did not."""
    if others := [run.name for run in matched.passed_over]:
        note(f"note: {study.name}: left out for runs of the same settings ({len(others)}): {shortened(others)}")


def section(study: Study, matched: Matched, everywhere: Runs, settings: Settings) -> tuple[str, list[str]]:
    """Figure, table and claims of a study as Markdown, and the claims' lines; draws its figures."""
    found, missing = matched.runs, matched.missing
    experiment = study.name if settings.size == "small" else f"paper/{study.name}"
    lines = [f"`python train.py -m experiment={experiment}`"]
    if left := missing + sum(not run.entry.run.summary for _, run in found):
        lines[0] += f" (unfinished runs: {left} of {missing + len(found)})"
    if not found:
        return lines[0], []
    beside = [(job, run) for job, run in everywhere if job.overrides["algo"] in study.beside]
    tasks = rows_of_study(study, found, beside)
    name = study.name if settings.size == "small" else f"{study.name}_paper"
    lines += figures(study, Path(settings.out).with_suffix("") / name, tasks)
    for title, groups in tasks:
        lines += ["", f"**{title}**"] if len(tasks) > 1 else []
        clock = clock_of([run for members in groups.values() for run in members])
        lines += ["", SCREEN_HEADER if study.on_screen else HEADER.format(time=AXES[clock])]
        for label, members in groups.items():
            lines += screen_rows(label, members) if study.on_screen else [table_row(label, members, clock)]
    verdicts = []
    for claim in study.claims:
        for title, groups in tasks:
            if claim.row in (None, title) and (verdict := claim.check(finals(groups))):
                row = f"{title}: " if claim.row else ""
                verdicts.append(f"| {row}{verdict.claim} | {verdict.outcome} | {verdict.measured} |")
    if verdicts:
        lines += ["", CLAIMS, *verdicts]
    return "\n".join(lines), verdicts


def figures(study: Study, path: Path, tasks: list[tuple[str, dict[str, list[Found]]]]) -> list[str]:
    """Draws a study; lines that show the pictures."""
    lines = []
    for drawing in study.drawings:
        picture = path.with_name(f"{path.name}{drawing.ending}.png")
        curves = [sum_up(row, groups, drawing) for row, groups in tasks]
        plot_curves(curves, [picture], panels=drawing.panels, axis=drawing.axis)
        lines += shown(picture, f"{study.title}: {drawing.shows}")
    for _, groups in tasks if study.on_screen else []:
        for label, members in groups.items():
            first = min(members, key=lambda run: value_of(run.entry, "seed"))
            if "legs/start_to_0" in first.entry.run.metrics:
                picture = path.with_name(f"{path.name}_legs_{label}.png")
                plot_legs_over_time(first.entry.run, first.settings["env.subgoals"], picture)
                lines += shown(picture, f"{study.title}: options of {label} that reached their subgoal")
    return lines


def shown(picture: Path, title: str) -> list[str]:
    """Lines that show a picture, which is made a third as large."""
    with Image.open(picture) as image:
        few_colours = image.convert("P", palette=Image.Palette.ADAPTIVE)
    few_colours.save(picture, optimize=True)
    return ["", f"![{title}]({picture.parent.name}/{picture.name})"]


def rows_of_study(study: Study, found: Runs, beside: Runs) -> list[tuple[str, dict[str, list[Found]]]]:
    """Titles of a study's rows and the runs of their groups, by label."""
    rows: dict[str, dict[str, list[Found]]] = {}
    for job, run in found:
        row = rows.setdefault(job.label([study.rows]) if study.rows else study.title, {})
        row.setdefault(job.label(study.by), []).append(run)
    for row in rows.values():
        for job, run in beside:
            row.setdefault(job.overrides["algo"], []).append(run)
    return list(rows.items())


def sum_up(title: str, groups: dict[str, list[Found]], drawing: Drawing) -> TaskResults:
    """Curves of the groups of a row."""
    columns = [name for panel in drawing.panels for name in panel.columns]
    summed = []
    for label, members in groups.items():
        entries = [each.entry for each in members]
        runs = [entry.run for entry in entries]
        estimates = estimate_curves(runs, columns, axis=drawing.axis)
        summed.append(Group(label, runs, estimates, common_references(entries, "known")))
    return TaskResults(title, summed)


def finals(groups: dict[str, list[Found]]) -> Results:
    """Final values of the finished runs by quantity and group."""
    import numpy as np

    results: dict[str, dict[str, Any]] = {}
    for label, members in groups.items():
        runs = [each.entry.run for each in members if each.entry.run.summary]
        if runs:
            for name in QUANTITIES:
                values = np.array([final_value(run, f"greedy/{name}") for run in runs])
                if np.isfinite(values).any():
                    results.setdefault(name, {})[label] = values[np.isfinite(values)]
    return results


def clock_of(members: list[Found]) -> str:
    """Which time a table of runs has: that of the processor, which older runs don't tell."""
    summaries = [each.entry.run.summary for each in members if each.entry.run.summary]
    return "processor_seconds" if all("processor_seconds" in each for each in summaries) else "wall_seconds"


def table_row(label: str, members: list[Found], clock: str) -> str:
    """Final results of a group as a line of a Markdown table."""
    finished = [each for each in members if each.entry.run.summary]
    if not finished:
        return f"| {label} | none finished | | | | | | | | | | {commits_in(members)} |"
    done = [each.entry.run for each in finished]
    seeds = ", ".join(sorted((value_of(each.entry, "seed") for each in finished), key=int))
    columns = [f"greedy/{name}" for name in QUANTITIES]
    mean = {name: each.value[0] for name, each in estimate_finals(done, columns).items()}
    score = estimate_finals(done, columns[:1])[columns[0]]
    trimmed = estimate_finals(done, columns[:1], center="iqm")[columns[0]].value[0]
    iqm = f"{trimmed:.2f}" if len(done) >= 4 else ""  # of fewer it is the mean
    interval = "" if score.low[0] != score.low[0] else f"{score.low[0]:.2f} to {score.high[0]:.2f}"
    ceiling = done[0].summary.get("ceiling")
    share = f"{mean[columns[0]] / ceiling:.0%}" if ceiling else ""
    frames = sum(run.summary["frames"] for run in done) / len(done)
    minutes = sum(run.summary[clock] for run in done) / len(done) / 60
    cells = (
        label, seeds, f"{mean[columns[0]]:.2f}", interval, iqm, share, f"{mean[columns[2]]:.0%}",
        f"{mean[columns[1]]:.0%}", f"{mean[columns[3]]:.1f}", f"{frames / 1000:.0f}k", f"{minutes:.0f} min",
        commits_in(finished),
    )  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def commits_in(members: list[Found]) -> str:
    """Commits of the code that made the runs."""
    return ", ".join(sorted({short_commit(commit) for each in members for commit in commits_of(each.origin)}))


def evaluations_of(folder: Path) -> list[dict[str, Any]]:
    """What evaluate.py wrote into a run folder; a file that can't be read is named in a warning."""
    found = []
    for path in sorted((folder / layout.EVALUATIONS).glob("*.json")):
        try:
            found.append(read_json(path, root=folder))
        except (OSError, RunFileError) as error:
            note(f"warning: {path} is left out: {error}")
    return found


def screen_rows(label: str, members: list[Found]) -> list[str]:
    """What ``evaluations/*.json`` of a group's runs say, as lines of a Markdown table."""
    rows = []
    for member in members:
        run = member.entry.run
        results = evaluations_of(run.folder)
        for result in sorted(results, key=lambda each: (each["env"]["sticky"], each["epsilon"])):
            key = result["per_subgoal"][list(result["env"]["subgoals"]).index("key")]["attained"]
            interval = result["intervals"]["return_mean"]
            reach = f"{interval[0]:.0f} to {interval[1]:.0f}" if interval and interval[0] < interval[1] else ""
            checkpoint = Path(result.get("checkpoint", "last")).name
            trained = result.get("frames") or run.metrics["frames"][-1]  # files of weights alone do not say
            frames = f"{trained / 1000:.0f}k{'' if checkpoint == 'last' else f', {checkpoint}'}"
            cells = (
                *(label, value_of(member.entry, "seed"), frames),
                *(f"{result['epsilon']:g}", f"{result['env']['sticky']:g}"),
                *(f"{result['return_mean']:.0f}", reach, f"{key:.0%}"),
                *(f"{result['success_rate']:.0%}", f"{result['steps_mean']:.0f}", f"{result['episodes']}"),
                commits_in([member]),
            )
            rows.append("| " + " | ".join(cells) + " |")
    return rows


def main() -> None:
    """Runs with the arguments of the command line."""
    command_line(Settings, __doc__, run)
