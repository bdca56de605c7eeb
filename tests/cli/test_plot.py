import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from processes import ROOT

from hdrqn_torchrl.cli import entries, plot
from hdrqn_torchrl.cli.command_line import command_line
from hdrqn_torchrl.runs.persistence import files

CONFIG = """\
env: {_target_: hdrqn_torchrl.envs.MultiGoalGridEnv, layout: open, num_envs: 64, num_goals: 2, view: VIEW, max_steps: STEPS, obstacle: stay}
algo: {_target_: hdrqn_torchrl.algorithms.make_hdrqn, version: v2, sub: {slice_len: LENGTH, learning_rate_frames: '${total_frames}'}}
network: {_target_: hdrqn_torchrl.modules.compact_network}
output_root: ${hydra:nowhere}
seed: SEED
total_frames: 300
"""  # noqa: E501
CLOCKS = "frames,episodes,updates,wall_seconds,processor_seconds"
COLUMNS = f"{CLOCKS},behaviour/return,behaviour/steps,greedy/return,greedy/success,greedy/ceiling"


def make_run(folder, *, algo="v2", env="gridworld", seed=0, view=5, steps=50, length=8, offset=0.0, finished=True):
    """A run folder as train.py writes it, with an evaluation at every second of five log points."""
    folder.mkdir(parents=True)
    config = CONFIG.replace("LENGTH", str(length)).replace("SEED", str(seed))
    (folder / "config.yaml").write_text(config.replace("VIEW", str(view)).replace("STEPS", str(steps)))
    (folder / "run.json").write_text(json.dumps({"choices": {"env": env, "algo": algo, "network": "compact"}}))
    rows = [COLUMNS]
    for index in range(5 if finished else 3):
        behaviour = f"{offset + index},{50 - index}" if index else ","
        greedy = f"{offset + index / 4},{index / 4},1.75" if index % 2 == 0 else ",,"
        rows.append(f"{index * 100},{index * 7},{index * 10},{index * 60.5},{index * 30.5},{behaviour},{greedy}")
    (folder / "metrics.csv").write_text("\n".join(rows) + ("\n" if finished else "\n300,21,3"))
    if finished:
        summary = {"return_mean": offset + 1.5, "success_rate": 0.75, "steps_mean": 20.0, "frames": 400}
        (folder / "summary.json").write_text(json.dumps(summary))
    return folder


@pytest.fixture
def run(monkeypatch, tmp_path, capsys):
    """Runs ``python plot.py ARGUMENTS`` in this process and returns what it printed; errors end it with a message."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["plot.py", *arguments])
        try:
            command_line(plot.Settings, plot.__doc__, plot.run)
        except SystemExit as ended:
            return "", str(ended)
        return capsys.readouterr()

    return call


@pytest.fixture
def outputs(tmp_path):
    for seed in range(2):
        make_run(tmp_path / f"outputs/gridworld-v2/seed{seed}", seed=seed, offset=seed)
        make_run(tmp_path / f"outputs/gridworld-dqn/seed{seed}", seed=seed, algo="dqn", finished=seed == 0)
    return tmp_path / "outputs"


def table(path="table.csv"):
    with Path(path).open() as file:
        return list(csv.DictReader(file))


def groups_of(rows):
    return sorted({row["group"] for row in rows})


def reference_lines(figure):
    return [
        [line.get_ydata()[0] for line in axis.get_lines() if list(line.get_xdata()) == [0, 1]] for axis in figure.axes
    ]


def test_curves_are_drawn_by_algorithm_with_ceilings(run, outputs, figures):
    out, err = run("runs=outputs/**", "out=figure.png")
    assert Path("figure.png").read_bytes().startswith(b"\x89PNG")
    assert out == "figure.png: runs 4, groups 2, tasks 1\n" and err == ""
    returns, steps = figures[0].axes
    assert (returns.get_ylabel(), steps.get_ylabel()) == ("reward per episode", "steps per episode")
    assert [text.get_text() for text in figures[0].legends[0].get_texts()][:2] == ["dqn (2 seeds)", "v2 (2 seeds)"]
    assert reference_lines(figures[0]) == [[2.0, 2.0, 2.0, -0.91], [12.1, 15.5, 16.5, 48.8]]


@pytest.mark.parametrize(
    ("kind", "endings"), [("curves", ["png", "csv"]), ("greedy", ["svg", "csv"]), ("bars", ["pdf", "csv"])]
)
def test_every_kind_is_drawn_in_every_format(run, outputs, kind, endings):
    names = ",".join(f"new/a.{ending}" for ending in endings)
    run("runs=outputs", f"kind={kind}", f"out=[{names}]", "columns=greedy/return", "ceilings=none")
    starts = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF", "csv": b"task,group,metric"}
    assert all(Path(f"new/a.{ending}").read_bytes().startswith(starts[ending]) for ending in endings)


def test_the_table_holds_estimates_by_hand(run, outputs):
    run("runs=outputs", "out=table.csv", "ceilings=none")
    rows = {(row["group"], row["metric"], row["x"]): row for row in table()}
    whole = rows["v2", "behaviour/return", "400"]
    assert (whole["estimate"], whole["low"], whole["high"], whole["seeds"]) == ("4.5", "-1.85310237", "10.8531024", "2")
    assert (whole["task"], whole["axis"]) == ("gridworld", "frames")
    beyond = rows["dqn", "behaviour/return", "400"]  # the second run has not got that far
    assert (beyond["estimate"], beyond["low"], beyond["seeds"]) == ("4", "", "1")
    assert ("dqn", "behaviour/return", "0") not in rows


def test_final_results_of_unfinished_runs_are_their_last_evaluation(run, outputs):
    _, err = run("runs=outputs", "out=table.csv", "kind=bars", "ceilings=none")
    returns = {row["group"]: row for row in table() if row["metric"] == "greedy/return"}
    last = [returns["dqn"][name] for name in ("axis", "estimate", "low", "high")]
    assert last == ["final", "1", "-5.35310237", "7.35310237"]
    assert returns["v2"]["estimate"] == "2"
    assert "dqn: 1 of 2 runs are unfinished" in err and err.count("unfinished") == 1


def test_time_to_a_threshold_is_averaged_only_if_all_runs_reach_it(run, outputs):
    _, err = run(
        "runs=outputs", "out=[table.csv,a.png]", "kind=bars", "columns=[wall_seconds until behaviour/return>=3]"
    )
    (row,) = table()
    assert (row["group"], row["estimate"], row["seeds"]) == ("v2", "151.25", "2")  # 181.5 and 121
    assert row["metric"] == "wall_seconds until behaviour/return>=3"
    assert "dqn: 1 of 2 runs have wall_seconds until behaviour/return>=3;" in err  # the quicker one alone is no mean


@pytest.mark.parametrize(
    ("x", "last"),
    [("frames", "400"), ("episodes", "28"), ("updates", "40"), ("wall_seconds", "242"), ("processor_seconds", "122")],
)
def test_any_clock_can_be_the_x_axis(run, outputs, x, last):
    run("runs=outputs", "out=[table.csv,a.png]", f"x={x}", "ceilings=none")
    assert {row["axis"] for row in table()} == {x}
    assert [row["x"] for row in table() if row["group"] == "v2"][-1] == last


def test_runs_can_be_grouped_by_nested_settings(run, tmp_path):
    for length in (8, 16):
        make_run(tmp_path / f"outputs/{length}", length=length)
    _, err = run("runs=outputs", "out=table.csv", "by=algo.sub.slice_len", "ceilings=none")
    assert groups_of(table()) == ["slice_len=16", "slice_len=8"] and err == ""
    run("runs=outputs", "out=table.csv", "by=algo,algo.sub.slice_len", "ceilings=none")
    assert groups_of(table()) == ["v2, slice_len=16", "v2, slice_len=8"]
    run("runs=outputs", "out=table.csv", "by=[network,run]", "ceilings=none")
    assert groups_of(table()) == ["compact, 16", "compact, 8"]


def test_runs_that_should_not_be_pooled_are_noted(run, tmp_path):
    for length in (8, 16):
        make_run(tmp_path / f"outputs/{length}", length=length)
    _, err = run("runs=outputs", "out=table.csv", "by=null", "ceilings=none")
    assert groups_of(table()) == ["all"]
    assert "note: all combines runs that differ in algo.sub.slice_len;" in err
    assert "note: all: several runs with seed 0;" in err


def test_tasks_have_their_own_rows_and_ceilings(run, tmp_path, figures):
    for view in (3, 5):
        make_run(tmp_path / f"outputs/{view}", view=view)
    run("runs=outputs", "out=[a.png,table.csv]")
    assert {row["task"] for row in table()} == {"gridworld, view=3", "gridworld, view=5"}
    assert [lines[1] for lines in reference_lines(figures[0])] == [2.0, 22.5, 2.0, 15.5]  # of the memory player


def test_pooled_tasks_share_only_the_ceilings_that_are_the_same(run, tmp_path, figures):
    make_run(tmp_path / "outputs/dqn", view=5, algo="dqn")
    for view in (3, 5):
        for seed in range(2):
            make_run(tmp_path / f"outputs/{view}-{seed}", view=view, seed=seed, offset=view)
    _, err = run("runs=outputs", "out=[a.png,table.csv]", "pool=true", "columns=behaviour/return,behaviour/steps")
    assert err == ""
    returns, steps = reference_lines(figures[0])
    assert returns == [2.0, -0.91] and steps == [12.1, 48.8]  # planner and random, which have no view
    last = [row for row in table() if row["metric"] == "behaviour/return"][-1]
    assert [last[name] for name in ("group", "estimate", "low", "high", "seeds")] == ["v2", "8", "", "", "4"]
    make_run(tmp_path / "outputs/5-2", view=5, seed=2, offset=5)
    _, err = run("runs=outputs", "out=table.csv", "pool=true", "columns=behaviour/return", "ceilings=none")
    assert err == "note: v2: tasks have 2 to 3 runs; each run has the same weight, so tasks do not\n"


def test_an_unmeasured_task_shows_the_ceiling_that_was_logged(run, tmp_path, figures):
    make_run(tmp_path / "outputs/a", steps=12)
    run("runs=outputs", "out=a.png")
    assert reference_lines(figures[0]) == [[1.75], []]


def test_an_unmeasured_task_can_be_simulated(run, tmp_path, figures):
    make_run(tmp_path / "outputs/a", steps=12)
    run("runs=outputs", "out=a.png", "ceilings=simulate")
    (planner, memory, egocentric, random), _ = reference_lines(figures[0])
    assert 2 > planner > memory > egocentric > random


def test_ceilings_can_be_left_out(run, outputs, figures):
    run("runs=outputs", "out=a.png", "ceilings=none")
    assert reference_lines(figures[0]) == [[], []]


@pytest.mark.parametrize(("center", "estimate"), [("mean", "24"), ("iqm", "5")])
def test_the_center_is_the_mean_or_the_iqm(run, tmp_path, center, estimate):
    for seed, offset in enumerate((0, 1, 1, 94)):
        make_run(tmp_path / f"outputs/{seed}", seed=seed, offset=offset)
    _, err = run("runs=outputs", "out=table.csv", f"center={center}", "columns=behaviour/return", "ceilings=none")
    assert table()[-1]["estimate"] == ("28" if center == "mean" else estimate)
    assert err == ""


def test_the_iqm_of_few_runs_says_that_it_is_the_mean(run, outputs):
    _, err = run("runs=outputs", "out=table.csv", "center=iqm", "ceilings=none")
    assert "note: v2: the IQM of fewer than 4 runs cuts nothing off" in err


def test_smoothing_averages_neighbouring_log_points(run, tmp_path):
    make_run(tmp_path / "outputs/a")
    run("runs=outputs", "out=table.csv", "smooth=3", "columns=behaviour/return", "ceilings=none")
    assert [float(row["estimate"]) for row in table()] == [1.5, 2, 3, 3.5]


def test_one_broken_run_does_not_hide_the_others(run, outputs):
    broken = {
        "cells": ("metrics.csv", "frames,loss\n1\n2,3\n"),
        "empty": ("metrics.csv", ""),
        "yaml": ("config.yaml", "env: [\n"),
        "list": ("config.yaml", "- 1\n"),
        "summary": ("summary.json", "{"),
    }
    for name, (file, text) in broken.items():
        (make_run(outputs / "broken" / name) / file).write_text(text)
    out, err = run("runs=outputs", "out=table.csv", "ceilings=none")
    assert "runs 4," in out
    assert len(err.splitlines()) == len(broken)
    for name, line in zip(sorted(broken), err.splitlines(), strict=True):
        assert line.startswith(f"warning: outputs/broken/{name} is left out: ")


def test_failed_runs_are_drawn_and_noted(run, outputs):
    (outputs / "gridworld-v2/seed1/error.txt").write_text("Traceback")
    out, err = run("runs=outputs", "out=table.csv", "ceilings=none")
    assert "runs 4," in out
    assert err == "note: 1 of the runs ended with an error (error.txt): outputs/gridworld-v2/seed1\n"


def test_a_folder_with_nothing_but_metrics_is_drawn(run, tmp_path):
    folder = make_run(tmp_path / "outputs/a")
    for name in ("config.yaml", "run.json", "summary.json"):
        (folder / name).unlink()
    _, err = run("runs=outputs", "out=[table.csv,a.png]")
    assert groups_of(table()) == ["none"] and err == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["runs=nothing/**", "out=a.png"], "at least one folder with a metrics.csv, got nothing/**, looked up in "),
        (["runs=outputs"], "out must be given"),
        (["runs=outputs", "out=a.jpg"], "out must end in one of .png, .svg, .pdf, .csv, got 'a.jpg'"),
        (["runs=outputs", "out=[a.png,b]"], "got 'b'"),
        (["runs=outputs", "out=[]"], "out must name at least one file"),
        (["runs=outputs", "out=outputs/metrics.csv"], "out must not have the name of a run's own data"),
        (["runs=outputs", "out=/dev/null/a.png"], "out must be a file that can be written, got"),
        (["runs=outputs", "out=a.png", "kind=lines"], "kind must be one of curves, greedy, discovery, bars, got"),
        (
            ["runs=outputs", "out=a.png", "x=steps"],
            "x must be one of frames, episodes, updates, wall_seconds, processor_seconds",
        ),
        (["runs=outputs", "out=a.png", "center=median"], "center must be one of mean, iqm, got 'median'"),
        (["runs=outputs", "out=a.png", "ceilings=all"], "ceilings must be one of known, simulate, none"),
        (["runs=outputs", "out=a.png", "smooth=-1"], "smooth must be >= 0, got -1"),
        (["runs=outputs", "out=a.png", "kind=bars", "smooth=2"], "must be left out with kind=bars"),
        (["runs=outputs", "out=a.png", "by=alog"], "got 'alog', which none of them has"),
        (["runs=outputs", "out=a.png", "by=algo.sub"], "single settings, got 'algo.sub'"),
        (["runs=outputs", "out=a.png", "columns=greedy/retrun"], "got 'greedy/retrun'"),
        (["runs=outputs", "out=a.png", "columns=frames until a>=1"], "got 'frames until a>=1'"),
        (["runs=outputs", "out=a.png", "kind=bars", "columns=frames until a>=1"], "got 'frames until a>=1'"),
        (["runs=outputs", "out=a.png", "color=red"], "color"),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else "",
)
def test_wrong_arguments_say_what_is_right(run, outputs, arguments, message):
    _, err = run(*arguments)
    assert err.startswith("error: ") and message in err
    assert not list(Path().glob("*.png"))


def test_runs_without_any_value_are_refused(run, tmp_path):
    (make_run(tmp_path / "outputs/a") / "metrics.csv").write_text("frames,behaviour/return\n0,\n")
    _, err = run("runs=outputs", "out=a.png")
    assert err.startswith("error: runs must hold at least one value to draw")


def test_only_broken_runs_are_refused(run, tmp_path):
    (make_run(tmp_path / "outputs/a") / "metrics.csv").write_text("")
    _, err = run("runs=outputs", "out=a.png")
    assert err == "error: runs must match at least one readable run; all 1 found were left out."


def test_the_program_draws_without_loading_torch(outputs, tmp_path):
    """It starts fast: torch is loaded only to look up ceilings."""
    code = (
        "import runpy, sys; sys.argv = ['plot.py', *sys.argv[1:]]; "
        "runpy.run_path(sys.argv[0], run_name='__main__'); assert 'torch' not in sys.modules"
    )
    arguments = [f"runs={outputs}/**", f"out={tmp_path}/figure.svg", "kind=greedy", "ceilings=none"]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "figure.svg").read_bytes().startswith(b"<?xml")


def test_help_explains_every_setting(run):
    for name in plot.Settings.__dataclass_fields__:
        assert f"\n{name} " in plot.__doc__


def test_many_runs_are_read_quickly(tmp_path, monkeypatch):
    """Nothing is read twice, and settings not by OmegaConf's slow parser."""
    for seed in range(5):
        make_run(tmp_path / f"outputs/{seed}", seed=seed)
    reads, open_file = [], files.open_file
    monkeypatch.setattr(
        files, "open_file", lambda path, *rest, **named: (reads.append(path), open_file(path, *rest, **named))[1]
    )
    monkeypatch.setattr("omegaconf.OmegaConf.load", None)
    assert len(entries.read_entries([str(tmp_path / "outputs/**")])) == 5
    assert len(reads) == len(set(reads)) == 20
