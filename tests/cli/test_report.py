import json
import re
import shutil
import sys
from contextlib import ExitStack
from functools import cache
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from PIL import Image

from hdrqn_torchrl.analysis.claims import Near
from hdrqn_torchrl.analysis.commits import commits_of
from hdrqn_torchrl.cli import report, study_runs
from hdrqn_torchrl.cli.command_line import command_line
from hdrqn_torchrl.cli.configuration import CONF
from hdrqn_torchrl.cli.studies import STUDIES, Job, is_run_of, jobs_of
from hdrqn_torchrl.runs.settings.comparing import NOT_LEARNED_FROM, flat

COLUMNS = (
    "frames,episodes,updates,wall_seconds,behaviour/return,behaviour/steps,greedy/return,greedy/success,greedy/steps"
)
EXPERIMENTS = sorted(path.stem for path in (Path(CONF) / "experiment" / "paper").glob("*.yaml"))


@cache
def composed(*overrides):
    """The text of a run's config.yaml, and Hydra's choices of files."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=list(overrides), return_hydra_config=True)
    choices = {str(key): value for key, value in config.hydra.runtime.choices.items()}
    return OmegaConf.to_yaml(OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])), choices


def make_run(folder, *overrides, score=1.0, finished=True, commit="0123456789", **summary):
    """A run folder as train.py writes it."""
    folder.mkdir(parents=True)
    config, choices = composed(*overrides)
    (folder / "config.yaml").write_text(config)
    (folder / "run.json").write_text(json.dumps({"choices": choices, "commit": commit, "overrides": overrides}))
    rows = [f"{i * 100},{i * 7},{i * 10},{i * 60.5},{score * i},{50 - i},{score * i},{i / 4},20" for i in range(5)]
    (folder / "metrics.csv").write_text("\n".join([COLUMNS, *rows]) + "\n")
    if finished:
        summary |= {"return_mean": score, "success_rate": 0.75, "in_order_rate": 0.8, "steps_mean": 21.0}
        (folder / "summary.json").write_text(json.dumps(summary | {"frames": 400, "wall_seconds": 60, "ceiling": 2.0}))
    return folder


@pytest.fixture
def run(monkeypatch, tmp_path, capsys):
    """Runs ``python report.py ARGUMENTS`` in this process and returns what it printed; errors end it with a message."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["report.py", *arguments])
        try:
            command_line(report.Settings, report.__doc__, report.run)
        except SystemExit as ended:
            return str(ended)
        return capsys.readouterr().out

    return call


@pytest.fixture
def without_figures(monkeypatch):
    """Figures of one pixel, for tests that only read text."""

    def plot_curves(_, paths, **settings):
        for path in paths:
            Image.new("RGB", (1, 1)).save(path)

    monkeypatch.setattr(report, "plot_curves", plot_curves)
    monkeypatch.setattr(report, "plot_legs_over_time", lambda run, names, path: plot_curves(None, [path]))


text_only = pytest.mark.usefixtures("without_figures")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Runs of a study: six finished, one unfinished, and one that does not belong to it."""
    folder, experiment = tmp_path_factory.mktemp("study"), "experiment=gridworld"
    for algo, score in (("v2", 1.6), ("v1", 1.2), ("dqn", 0.2)):
        for seed in (0, 1):
            overrides = experiment, f"algo={algo}", f"seed={seed}"
            make_run(folder / f"{algo}-seed{seed}", *overrides, score=score + seed / 100)
    make_run(folder / "hdqn", experiment, "algo=hdqn", finished=False)
    make_run(folder / "other", experiment, "algo=v2", "algo.gamma=0.9", score=9.0)
    return folder


@pytest.fixture
def outputs(study, tmp_path):
    return shutil.copytree(study, tmp_path / "outputs")


def test_a_report_holds_figures_tables_and_claims_of_a_study(run, outputs):
    assert run("runs=outputs", "out=results.md", "studies=gridworld") == "gridworld: runs 7, missing 23\n"
    text = Path("results.md").read_text()
    assert "`python train.py -m experiment=gridworld` (unfinished runs: 24 of 30)" in text
    row = next(line for line in text.splitlines() if line.startswith("| v2 |"))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    expected = "v2", "0, 1", "1.60", "1.54 to 1.67", "", "80%", "80%", "75%", "21.0", "0k", "1 min", "0123456"
    assert tuple(cells) == expected
    assert "| hdqn | none finished |" in text
    assert "| v2 takes 22 steps (within 1.5) | open | v2 21 |" in text
    assert "above hdqn" not in text  # it has not finished, so nothing is claimed of it
    for name in ("gridworld.png", "gridworld_greedy.png"):
        assert (Path("results") / name).stat().st_size > 100
    assert "(results/gridworld.png)" in text


@text_only
def test_claims_are_checked_against_finished_runs(run, outputs):
    for algo, score in (("hdqn", 0.8), ("drqn", 0.3)):
        make_run(outputs / f"done-{algo}", "experiment=gridworld", f"algo={algo}", score=score)
    run("runs=outputs", "out=results.md", "studies=gridworld")
    text = Path("results.md").read_text()
    assert "| v2 above v1 | agrees | v2 1.6 ± 0.0635, v1 1.21 ± 0.0635 |" in text
    assert "| hdqn above drqn and dqn | open (one seed) | hdqn 0.8, drqn 0.3, dqn 0.205 ± 0.0635 |" in text
    assert "claims small" not in text  # of some studies alone there is no overview


@text_only
def test_a_report_on_all_studies_begins_with_an_overview_of_claims(run, outputs):
    run("runs=outputs", "out=results.md")
    overview = Path("results.md").read_text().partition("<!-- claims small -->")[2]
    assert "| study | claim (of greedy play at the end) | | measured |\n|---|---|---|---|" in overview
    assert (
        "| All algorithms, gridworld, two goals | v2 above v1 | agrees | v2 1.6 ± 0.0635, v1 1.21 ± 0.0635 |"
        in overview
    )


@text_only
def test_text_outside_the_marks_is_left_unchanged(run, outputs):
    run("runs=outputs", "out=results.md", "studies=gridworld")
    generated = Path("results.md").read_text()
    Path("results.md").write_text(generated.replace("# Results\n", "# Ours\n\nBefore.\n") + "\nAfter.\n")
    run("runs=outputs", "out=results.md", "studies=gridworld")
    assert Path("results.md").read_text() == generated.replace("# Results\n", "# Ours\n\nBefore.\n") + "\nAfter.\n"


def test_an_archive_gives_the_same_report(run, outputs):
    run("runs=outputs", "out=a.md", "studies=gridworld", "keep=kept/runs.tar.xz")
    kept = Path("kept/runs.tar.xz").read_bytes()
    run("runs=kept/runs.tar.xz", "out=b.md", "studies=gridworld", "keep=again.tar.xz")
    assert Path("b.md").read_text() == Path("a.md").read_text().replace("(a/", "(b/")
    assert Path("again.tar.xz").read_bytes() == kept
    assert (Path("a") / "gridworld.png").read_bytes() == (Path("b") / "gridworld.png").read_bytes()


@text_only
def test_of_equal_runs_the_one_in_the_place_named_last_counts(run, outputs, tmp_path):
    """Whatever the places are called: an archive is unpacked to a folder that may come before or after any other."""
    run("runs=outputs", "out=a.md", "studies=gridworld", "keep=runs.tar.xz")
    make_run(tmp_path / "new/dqn", "experiment=gridworld", "algo=dqn", "seed=0", score=5.0)
    for places, new in (("runs.tar.xz,new", True), ("new,runs.tar.xz", False)):
        assert run(f"runs=[{places}]", "out=b.md", "studies=gridworld") == "gridworld: runs 7, missing 23\n"
        assert ("| dqn | 0, 1 | 2.60 |" in Path("b.md").read_text()) == new


def test_runs_that_are_left_out_for_others_are_named(run, outputs, tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(report, "note", told.append)
    make_run(tmp_path / "new/dqn", "experiment=gridworld", "algo=dqn", "seed=0", score=5.0)
    run("runs=[outputs,new]", "out=a.md", "studies=gridworld")
    assert told == ["note: gridworld: left out for runs of the same settings (1): outputs/dqn-seed0"]
    run("runs=outputs", "out=a.md", "studies=gridworld", "keep=kept/runs.tar.xz")
    told.clear()
    run("runs=[kept/runs.tar.xz,new]", "out=a.md", "studies=gridworld")
    assert len(told) == 1 and re.search(r" \(1\): kept/runs\.tar\.xz: [\w-]+$", told[0])


def test_what_an_author_writes_meanwhile_stays(run, outputs, monkeypatch):
    run("runs=outputs", "out=a.md", "studies=gridworld")
    section = report.section

    def write(*arguments):
        with Path("a.md").open("a") as file:
            file.write("mine\n")
        return section(*arguments)

    monkeypatch.setattr(report, "section", write)
    run("runs=outputs", "out=a.md", "studies=gridworld")
    assert Path("a.md").read_text().endswith("mine\n")


def test_the_part_of_a_study_without_any_run_stays_as_it_is(run, outputs, tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(report, "note", told.append)
    run("runs=outputs", "out=a.md")
    before = Path("a.md").read_text()
    (tmp_path / "empty").mkdir()
    make_run(tmp_path / "other/dqn", "env=gridworld", "algo=dqn", "seed=77", "total_frames=999")
    run("runs=other", "out=a.md")
    assert Path("a.md").read_text() == before and "| dqn |" in before
    assert "note: gridworld: none of its runs is there, so its part of a.md stays as it is" in told


@text_only
class TestArchive:
    def test_it_holds_the_runs_of_all_studies_and_sizes(self, run, outputs, tmp_path):
        make_run(tmp_path / "outputs/views", "experiment=views", "algo=v1", "env.view=3")  # others have 5
        make_run(tmp_path / "outputs/large", "experiment=paper/gridworld", "algo=v1")
        run("runs=outputs", "out=a.md", "studies=gridworld", "keep=runs.tar.xz")
        assert run("runs=runs.tar.xz", "out=b.md", "studies=views") == "views: runs 5, missing 22\n"
        large = run("runs=runs.tar.xz", "out=c.md", "studies=gridworld", "size=paper")
        assert large == "gridworld: runs 1, missing 17\n"

    def test_one_that_is_not_read_is_not_overwritten(self, run, outputs):
        run("runs=outputs", "out=a.md", "studies=gridworld", "keep=runs.tar.xz")
        kept = Path("runs.tar.xz").read_bytes()
        message = run("runs=outputs", "out=a.md", "studies=gridworld", "keep=runs.tar.xz")
        assert message.startswith("error: keep must be a new file or an archive that runs names, too")
        assert "give 'runs=[runs.tar.xz,outputs]' or another name" in message
        assert run("runs=[runs.tar.xz,outputs]", "out=a.md", "studies=gridworld", "keep=./runs.tar.xz").startswith(
            "grid"
        )
        assert Path("runs.tar.xz").read_bytes() == kept


@text_only
def test_a_table_has_processor_time_where_all_runs_tell_it(run, tmp_path):
    for seed in (2, 10):
        make_run(
            tmp_path / f"outputs/{seed}", "experiment=gridworld", "algo=v1", f"seed={seed % 5}", processor_seconds=180
        )
    run("runs=outputs", "out=a.md", "studies=gridworld")
    text = Path("a.md").read_text()
    assert "| frames | processor time | commit |" in text and "| 3 min | 0123456 |" in text
    make_run(tmp_path / "outputs/older", "experiment=gridworld", "algo=v2")
    run("runs=outputs", "out=a.md", "studies=gridworld")
    text = Path("a.md").read_text()
    assert "| frames | wall time | commit |" in text and "| 3 min |" not in text


def test_seeds_stand_in_the_order_of_numbers_and_commits_are_of_runs_that_count(run, tmp_path):
    runs = [make_run(tmp_path / f"{seed}", "experiment=gridworld", f"seed={seed}") for seed in (10, 9)]
    runs.append(make_run(tmp_path / "going", "experiment=gridworld", "seed=1", commit="fedcba9876", finished=False))
    origin = json.loads((runs[0] / "run.json").read_text())
    went_on = [{"commit": "89abcdef01-dirty"}]
    (runs[0] / "run.json").write_text(json.dumps(origin | {"resumed_with": went_on}))
    with ExitStack() as stack:
        members = study_runs.read_runs([str(tmp_path)], stack)
    for broken in ({"resumed_with": 3}, {"resumed_with": ["x", None]}, {"overrides": 3}):
        assert study_runs.Found(members[0].entry, {}, broken).overridden == set()
        assert commits_of({"commit": "0123456789", **broken}) == ["0123456789"]
    row = report.table_row("v2", members, "wall_seconds")
    assert row.startswith("| v2 | 9, 10 |") and row.endswith("| 0123456, 89abcde-dirty |")


@text_only
def test_a_study_has_a_row_for_each_value_and_shows_other_agents_for_comparison(run, tmp_path):
    for algo in ("v1", "v2"):
        for length in (1, 8):
            settings = f"algo={algo}", f"algo.sub.slice_len={length}", "algo.meta.slice_len=1"
            make_run(tmp_path / f"outputs/{algo}-{length}", "experiment=sub_sequences", *settings, score=length / 8)
    make_run(tmp_path / "outputs/v3", "experiment=gridworld", "algo=v3")
    assert run("runs=outputs", "out=results.md", "studies=sub_sequences") == "sub_sequences: runs 4, missing 46\n"
    text = Path("results.md").read_text()
    assert text.index("**v1**") < text.index("| slice_len=1 |") < text.index("| v3 |") < text.index("**v2**")


@text_only
def test_a_run_has_the_label_that_its_study_gives_it(run, outputs):
    """The variant v2 of one study is the algorithm v2 of another."""
    make_run(outputs / "cell", "experiment=authors_choices", "variant=v2_cell")
    assert run("runs=outputs", "out=results.md", "studies=authors_choices") == "authors_choices: runs 3, missing 15\n"
    rows = [line.split("|")[1].strip() for line in Path("results.md").read_text().splitlines() if line[:4] == "| v2"]
    assert rows == ["v2", "v2_cell"]


class TestScreen:
    """Montezuma's Revenge: score, key and door as evaluate.py measured them, and legs."""

    @pytest.fixture
    def folder(self, tmp_path):
        folder = make_run(tmp_path / "outputs/v3", "experiment=montezuma", "algo=v3", finished=False)
        places = [*range(6), "start"]
        extra = {"behaviour/attained_3": 0.5, "behaviour/success": 0.25}
        extra |= {f"behaviour/visits_{number}": number for number in range(6)}
        extra |= {f"legs/{place}_to_{goal}": 0.75 for place in places for goal in range(6)}
        names, *rows = (folder / "metrics.csv").read_text().splitlines()
        added = ",".join(map(str, extra.values()))
        (folder / "metrics.csv").write_text(
            "\n".join([f"{names},{','.join(extra)}", *(f"{r},{added}" for r in rows), ""])
        )
        (folder / "evaluations").mkdir()
        for name, epsilon, sticky, checkpoint in (("a", 0.05, 0.25, "best"), ("b", 0.0, 0.0, "last")):
            subgoals = [{"attained": 0.0}, {"attained": 0.85}]
            env = {"subgoals": ["left_door", "key"], "sticky": sticky}
            result = {"env": env, "epsilon": epsilon, "episodes": 100, "per_subgoal": subgoals, "return_mean": 310.2}
            result |= {"intervals": {"return_mean": [290.4, 330.0]}, "success_rate": 0.75, "steps_mean": 190.0}
            result |= {"checkpoint": checkpoint, **({"frames": 2_000} if checkpoint == "best" else {})}
            (folder / f"evaluations/{name}.json").write_text(json.dumps(result))
        return folder

    def test_the_screen_study_has_a_table_and_figures(self, run, folder):
        assert run("runs=outputs", "out=results.md", "studies=montezuma") == "montezuma: runs 1, missing 5\n"
        text = Path("results.md").read_text()
        rows = [line for line in text.splitlines() if line.startswith("| v3")]
        assert rows == [
            "| v3 | 0 | 0k | 0 | 0 | 310 | 290 to 330 | 85% | 75% | 190 | 100 | 0123456 |",
            "| v3 | 0 | 2k, best | 0.05 | 0.25 | 310 | 290 to 330 | 85% | 75% | 190 | 100 | 0123456 |",
        ]
        for name in ("montezuma", "montezuma_right", "montezuma_left", "montezuma_legs_v3"):
            assert f"(results/{name}.png)" in text and (Path("results") / f"{name}.png").stat().st_size > 100

    @text_only
    def test_an_archive_keeps_evaluations_of_the_screen(self, run, folder):
        run("runs=outputs", "out=a.md", "studies=montezuma", "keep=runs.tar.xz")
        run("runs=runs.tar.xz", "out=b.md", "studies=montezuma")
        assert Path("b.md").read_text() == Path("a.md").read_text().replace("(a/", "(b/")


def test_runs_of_another_size_do_not_count(run, outputs):
    message = run("runs=outputs", "out=results.md", "studies=gridworld", "size=paper")
    assert message == "gridworld: runs 0, missing 18\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["size=huge"], "error: size must be one of small, paper, got 'huge'."),
        (["studies=gridword"], "error: studies must be some of .*, got 'gridword'."),
        (["out=results.txt"], "error: out must end in .md, got 'results.txt'; "),
        (
            ["out=/dev/null.md"],
            "error: out must be a page whose figures can lie in a folder /dev/null, got ",
        ),
        (["keep=runs.zip"], "error: keep must end in .tar.xz, got 'runs.zip'; for example keep=runs.tar.xz."),
        (["runs=broken.tar.xz"], "error: runs must name folders or readable archives, got broken.tar.xz: "),
    ],
)
def test_wrong_settings_are_refused(run, outputs, arguments, message):
    Path("broken.tar.xz").write_text("no archive")
    assert re.match(message, run("runs=outputs", *arguments))


class TestStudies:
    def test_each_experiment_of_the_paper_is_a_study(self):
        assert sorted(study.name for study in STUDIES if "paper" in study.sizes) == EXPERIMENTS

    @pytest.mark.parametrize("study", [each for each in STUDIES if "paper" in each.sizes], ids=lambda study: study.name)
    def test_a_study_has_jobs_in_both_sizes(self, study):
        small, paper = jobs_of(study.name), jobs_of(f"paper/{study.name}")
        seeds = {job.settings["seed"] for job in small}
        assert len(small) == len(paper) * len(seeds) // 3 >= 9
        assert all(is_run_of(job, other.settings) == (job is other) for job in small for other in small)
        assert seeds == set(range(5 if study.name in ("gridworld", "four_rooms", "sub_sequences") else 3))
        assert all(job.settings["network._target_"].endswith("paper_network") for job in paper)
        assert min(job.settings["total_frames"] for job in paper) > max(job.settings["total_frames"] for job in small)
        assert all(job.label(study.by) for job in small)

    @pytest.mark.parametrize("study", [each for each in STUDIES if each.claims], ids=lambda study: study.name)
    def test_claims_name_groups_that_exist(self, study):
        """A claim about another group would never be checked."""
        labels = {job.label(study.by) for job in jobs_of(study.name)}
        rows = {job.label([study.rows]) for job in jobs_of(study.name)} if study.rows else set()
        for claim in study.claims:
            groups = [claim.group] if isinstance(claim, Near) else claim.groups
            assert {name for names in groups for name in ([names] if isinstance(names, str) else names)} <= labels
            assert claim.row is None or claim.row in rows

    def test_the_search_is_the_same_for_every_algorithm(self):
        tried: dict[str, set[str]] = {}
        for name in ("tuning_flat", "tuning_hierarchical"):
            study = next(each for each in STUDIES if each.name == name)
            for job in jobs_of(name):
                tried.setdefault(job.overrides["algo"], set()).add(job.label(study.by))
        assert sorted(tried) == ["dqn", "drqn", "hdqn", "v1", "v2"]
        assert all(each == tried["v2"] for each in tried.values())
        assert len(tried["v2"]) == 4

    def test_a_run_belongs_to_a_job_if_the_settings_of_both_agree(self):
        found = {"seed": 0, "output_root": "a", "algo": {"gamma": 0.9, "tau": 0.1}, "resume": None}
        settings = flat(found, without=NOT_LEARNED_FROM)
        assert settings == {"seed": 0, "algo.gamma": 0.9, "algo.tau": 0.1}
        job = Job({}, settings)
        assert is_run_of(job, settings)
        assert is_run_of(job, {"seed": 0, "algo.gamma": 0.9})  # it is older than tau
        assert not is_run_of(job, settings | {"algo.gamma": 0.8})
        assert not is_run_of(job, settings | {"algo.other": 1})


def test_the_kept_runs_still_belong_to_their_studies():
    """Settings that were renamed or left to the task since they were made must not keep them from matching."""
    with ExitStack() as stack:
        kept = study_runs.read_runs([str(Path(CONF).parent / "docs" / "results" / "runs.tar.xz")], stack)
        found = study_runs.runs_of_jobs("gridworld", "small", kept)
        of_authors = study_runs.runs_of_jobs("authors_choices", "small", kept)
    assert (len(found.runs), found.missing, found.passed_over) == (30, 0, [])
    assert len({run.entry.run.folder for _, run in found.runs}) == 30
    assert len(of_authors.runs) > 0


def test_a_bound_that_a_job_leaves_to_the_task_is_not_compared():
    job = Job({}, {"algo.sub.max_target": None, "algo.gamma": 0.9})
    assert is_run_of(job, {"algo.sub.max_target": 1.0, "algo.gamma": 0.9})
    assert not is_run_of(job, {"algo.sub.max_target": 1.0, "algo.gamma": 0.99})
    unbounded = Job({}, {"algo.sub.max_target": "unbounded"})
    assert not is_run_of(unbounded, {"algo.sub.max_target": 1.0})
    assert is_run_of(unbounded, {"algo.sub.max_target": None})  # what it was called before
    assert not is_run_of(Job({}, {}), {"algo.sub.max_target": 1.0})


def test_a_run_with_a_bound_of_its_own_is_another_one(tmp_path):
    job = next(each for each in jobs_of("gridworld") if each.overrides == {"algo": "v3", "seed": "0"})
    make_run(tmp_path / "same", "experiment=gridworld", "algo=v3")
    make_run(tmp_path / "short", "experiment=gridworld", "algo=v3", "algo.learner.slice_len=10")
    make_run(tmp_path / "bounded", "experiment=gridworld", "algo=v3", "algo.max_meta_target=0.5")
    with ExitStack() as stack:
        runs = study_runs.read_runs([str(tmp_path)], stack)
    matching = [run.entry.run.folder.name for run in runs if is_run_of(job, run.settings, run.overridden)]
    assert matching == ["same"]


def test_an_evaluation_that_can_not_be_read_is_named_and_left_out(tmp_path, capsys):
    folder = tmp_path / "evaluations"
    folder.mkdir()
    (folder / "greedy.json").write_text('{"episodes": 3}')
    (folder / "broken.json").write_text("{")
    (folder / "elsewhere.json").symlink_to(folder / "greedy.json")
    assert report.evaluations_of(tmp_path) == [{"episodes": 3}]
    told = capsys.readouterr().err
    assert "broken.json must be a JSON file" in told and "elsewhere.json must be what a run leaves there" in told
