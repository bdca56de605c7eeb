"""Where a training starts: in a new folder, or where an earlier one stopped."""

import json
import os
import re
import shlex
from functools import cache
from pathlib import Path

import pytest
import yaml
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf, open_dict
from run_folders import CONF, HOSTILE, REFUSED_WHEN_BUILT, SMALL

from hdrqn_torchrl.cli import origin
from hdrqn_torchrl.cli.changed_settings import differences
from hdrqn_torchrl.cli.configuration import resolved
from hdrqn_torchrl.cli.origin import record
from hdrqn_torchrl.cli.resuming import Plan, command, find_same, plan, with_groups_of_run
from hdrqn_torchrl.runs.persistence.layout import holds_run, split
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.run_settings import as_plain, check


@cache
def composed(*overrides):
    with initialize_config_dir(CONF, version_base="1.3"):
        return compose("config", overrides=list(overrides), return_hydra_config=True)


def compose_with_hydra(*overrides):
    """The settings of a command line; Hydra knows them as it does in train.py."""
    config = composed(*overrides)
    HydraConfig.instance().set_config(config)
    config = config.copy()
    with open_dict(config):
        del config["hydra"]
    return resolved(config)


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    yield
    HydraConfig.instance().cfg = None


def make_run(folder, *overrides):
    """Writes the files of a run with these settings; returns its folder."""
    folder = Path(folder)
    config = compose_with_hydra(*SMALL, *overrides)
    folder.mkdir(parents=True)
    record(Plan(folder, config, dict(HydraConfig.get().runtime.choices), resumed=False))
    return folder


def plan_for(*overrides, folder="outputs/gridworld-v2/new"):
    config = compose_with_hydra(*overrides)
    Path(folder).mkdir(parents=True, exist_ok=True)  # Hydra makes it
    return plan(config, Path(folder))


class TestANewRun:
    def test_a_new_run_starts_in_hydras_folder(self):
        run = plan_for("seed=3", "algo=drqn")
        assert (run.folder, run.config.seed, run.resumed, run.checkpoint) == (
            Path("outputs/gridworld-v2/new"), 3, False, None,
        )  # fmt: skip
        assert (run.choices["algo"], run.choices["env"]) == ("drqn", "gridworld")

    @pytest.mark.parametrize("content", ["config.yaml", "checkpoints"])
    def test_a_new_run_does_not_overwrite_another(self, content):
        folder = Path("taken")
        (folder / content).mkdir(parents=True)
        assert holds_run(folder)
        with pytest.raises(
            SettingsError, match=r"^taken already holds a run, .*`python train\.py resume=taken` goes on"
        ):
            plan_for(folder=folder)

    @pytest.mark.parametrize(
        "name",
        ["run", "a b", "a#b", "a=b,c", "(a) [b]", "jörg's", 'a"b', "~a", "@a%b", "null", "true", "1e3", "007"],
    )
    def test_the_command_to_resume_can_be_typed_as_it_is_printed(self, name):
        words = shlex.split(command(Path(name), ["mine.Env", "http://here?x=y,z"]))
        resume, allowed = OverridesParser.create().parse_overrides(words[2:])
        assert words[:2] == ["python", "train.py"]
        assert str(resume.value()) == name and allowed.value() == ["mine.Env", "http://here?x=y,z"]

    def test_a_folder_called_auto_is_not_taken_for_the_newest_run(self):
        assert command(Path("auto")) == "python train.py resume=./auto"

    def test_a_folder_whose_full_path_looks_like_a_reference_is_named_by_its_relative_path(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "${here}").mkdir()
        monkeypatch.chdir(tmp_path / "${here}")
        assert command(Path.cwd() / "out") == "python train.py resume=out"

    def test_a_folder_whose_relative_path_looks_like_a_reference_is_refused(self):
        with pytest.raises(
            SettingsError, match=r"^hydra\.run\.dir must be a folder without \$\{ in its name, got a\$\{b"
        ):
            plan_for(folder="a${b}")

    def test_a_variant_of_another_algorithm_is_refused(self):
        with pytest.raises(
            SettingsError, match=r"^variant=v2_lambda must be given with its own algorithm, v2, got algo=v3"
        ):
            plan_for("variant=v2_lambda", "algo=v3")
        assert plan_for("variant=v2_lambda", "algo=v2").choices["algo"] == "v2"

    def test_the_command_to_resume_names_no_builders_if_none_were_allowed(self):
        assert command(Path("out/run")) == "python train.py resume=out/run"

    def test_a_folder_with_other_files_does_not_count_as_a_run(self):
        Path("used").mkdir()
        (Path("used") / "notes.txt").write_text("mine")
        assert not holds_run(Path("used")) and not plan_for(folder="used").resumed


class TestResumingAFolder:
    def test_a_resumed_run_keeps_all_its_settings(self):
        run = make_run("outputs/a/1", "seed=7", "algo.gamma=0.9", "algo=v1", "env=four_rooms")
        found = plan_for(f"resume={run}")
        assert (found.folder, found.resumed, found.checkpoint) == (run, True, None)
        assert (found.config.seed, found.config.algo["gamma"], found.config.env["layout"]) == (7, 0.9, "four_rooms")
        assert (found.choices["algo"], found.choices["env"]) == ("v1", "four_rooms")
        check(found.config)

    def test_resuming_removes_the_new_folder_that_hydra_made(self):
        run = make_run("outputs/a/1")
        plan_for(f"resume={run}", folder="outputs/b/new")
        assert sorted(path.name for path in Path("outputs").iterdir()) == ["a"]
        (Path("outputs") / "c" / "new").mkdir(parents=True)
        (Path("outputs") / "c" / "new" / "mine").write_text("")
        plan_for(f"resume={run}", folder="outputs/c/new")
        assert (Path("outputs") / "c" / "new" / "mine").exists()

    def test_total_frames_can_be_raised_and_settings_that_follow_them_are_raised_too(self):
        run = make_run("outputs/a/1", "total_frames=1000")
        found = plan_for(f"resume={run}", "total_frames=3000")
        assert found.config.total_frames == 3000 == found.config.algo["sub"]["learning_rate_frames"]

    def test_total_frames_can_not_be_lowered(self):
        run = make_run("outputs/a/1", "total_frames=1000")
        with pytest.raises(SettingsError, match=r"total_frames: 1000 -> 500 \(it can only be raised\)"):
            plan_for(f"resume={run}", "total_frames=500")

    def test_other_settings_are_refused_with_a_list_of_them(self):
        run = make_run("outputs/a/1", "seed=1")
        with pytest.raises(SettingsError) as refusal:
            plan_for(f"resume={run}", "seed=2", "algo.sub.tau=0.5", "env.view=5", "threads=2", "algo.gamma=0.99")
        assert str(refusal.value).splitlines() == [
            "settings must be those of the run that is resumed, and differ from outputs/a/1:",
            "  algo.sub.tau: 0.003 -> 0.5",
            "  env.view: 3 -> 5",
            "  seed: 1 -> 2",
            "  threads: 1 -> 2",
            "Leave them out, or take the new ones with resume_override=true.",
        ]

    def test_other_settings_are_taken_with_resume_override(self):
        run = make_run("outputs/a/1", "seed=1")
        found = plan_for(f"resume={run}", "seed=2", "algo.sub.tau=0.5", "resume_override=true", "total_frames=5")
        assert (found.config.seed, found.config.algo["sub"]["tau"], found.config.total_frames) == (2, 0.5, 5)
        assert found.config.env["view"] == 3  # of the run, not of conf/

    @pytest.mark.parametrize(
        "override", ["checkpoint.interval_frames=7", "checkpoint.keep_last=5", "output_root=other"]
    )
    def test_settings_that_do_not_affect_the_training_may_change(self, override):
        run = make_run("outputs/a/1")
        key, _, value = override.partition("=")
        assert (
            str(OmegaConf.select(OmegaConf.create(as_plain(plan_for(f"resume={run}", override).config)), key)) == value
        )

    def test_the_same_group_may_be_named_again_and_keeps_the_runs_changes_to_it(self):
        run = make_run("outputs/a/1", "algo=v1", "algo.sub.tau=0.5")
        assert plan_for(f"resume={run}", "algo=v1").config.algo["sub"]["tau"] == 0.5

    def test_another_group_than_the_runs_is_refused(self):
        run = make_run("outputs/a/1", "algo=v1")
        with pytest.raises(
            SettingsError, match=r"(?s)algo\.recurrent: true -> false|algo\._target_: .*make_hdrqn -> .*make_drqn"
        ):
            plan_for(f"resume={run}", "algo=drqn")
        with pytest.raises(SettingsError, match="experiment=as_in_paper can't be given with resume=FOLDER"):
            plan_for(f"resume={run}", "experiment=as_in_paper")

    def test_settings_are_those_of_the_runs_groups_without_naming_them(self):
        run = make_run("outputs/a/1", "algo=v1", "env=four_rooms")
        typed = [f"resume={run}", "algo.gamma=0.8", "env.view=5", "total_frames=800_001"]
        assert with_groups_of_run(typed) == [*typed, "algo=v1", "env=four_rooms"]
        with pytest.raises(SettingsError, match=r"(?s):\n  algo\.gamma: 0\.99 -> 0\.8\n  env\.view: 3 -> 5\nLeave"):
            plan_for(*with_groups_of_run(typed))
        for given in (["algo=v2", *typed], typed[1:], ["resume=auto", *typed[1:]], ["resume=nowhere", *typed[1:]]):
            assert with_groups_of_run(given)[: len(given)] == given and "algo=v1" not in with_groups_of_run(given)

    @pytest.mark.parametrize("choice", ["../../elsewhere", "v3 env=mine", "[v3]"])
    def test_a_run_folder_names_no_file_that_lies_elsewhere(self, choice):
        run = make_run("outputs/a/1")
        (run / "run.json").write_text(json.dumps({"choices": {"algo": choice}}))
        typed = [f"resume={run}", "algo.gamma=0.8"]
        assert with_groups_of_run(typed) == typed

    def test_a_run_without_a_recorded_origin_can_be_resumed(self):
        run = make_run("outputs/a/1", "seed=3", "algo=v1")
        (run / "run.json").unlink()
        found = plan_for(f"resume={run}")
        assert found.config.seed == 3 and found.choices["algo"] == "v2"  # of this command: only a heading
        with pytest.raises(SettingsError, match="seed: 3 -> 4"):
            plan_for(f"resume={run}", "seed=4")

    def test_a_checkpoint_of_the_run_can_be_named(self):
        run = make_run("outputs/a/1")
        path = run / "checkpoints" / "checkpoint-000000000100"
        found = plan_for(f"resume={path}")
        assert (found.folder, found.checkpoint) == (run, path)
        assert split(Path("a/checkpoints/b/")) == (Path("a"), Path("a/checkpoints/b")) and split(Path("a")) == (
            Path("a"),
            None,
        )

    @pytest.mark.parametrize("folder", ["nowhere", "outputs"])
    def test_a_folder_that_is_not_a_run_is_refused(self, folder):
        with pytest.raises(SettingsError, match=rf"^run must be the folder of a training, got {folder}, which has no"):
            plan_for(f"resume={folder}")

    def test_a_wrong_value_is_reported(self):
        run = make_run("outputs/a/1")
        with pytest.raises(SettingsError, match=r"checkpoint\.keep_last must be >= 2, got 1"):
            plan_for(f"resume={run}", "checkpoint.keep_last=1")


class TestResumingTheSameCommand:
    def test_the_same_command_starts_a_new_run_if_there_is_none_yet(self):
        found = plan_for("resume=auto")
        assert (found.folder, found.resumed) == (Path("outputs/gridworld-v2/new"), False)

    def test_the_newest_run_with_the_same_settings_is_found(self):
        for age, (name, overrides) in enumerate(
            [("a/1", ["seed=1"]), ("a/2", ["seed=1"]), ("b/3", ["seed=2"]), ("a/4", ["seed=1", "env.view=5"])]
        ):
            os.utime(make_run(f"outputs/{name}", *overrides) / "config.yaml", (age, age))
        found = plan_for("resume=auto", *SMALL, "seed=1")
        assert found.folder == Path("outputs/a/2") and found.resumed and found.checkpoint is None

    def test_a_run_of_fewer_frames_is_resumed_but_not_one_of_more(self):
        run = make_run("outputs/a/1", "total_frames=1000")
        assert plan_for("resume=auto", *SMALL, "total_frames=2000").folder == run
        assert plan_for("resume=auto", *SMALL, "total_frames=500").folder != run

    @staticmethod
    def before(run, *settings):
        """Makes a run one of a version that did not have these settings of its algorithm."""
        stored = yaml.safe_load((run / "config.yaml").read_text())
        for name in settings:
            del stored["algo"][name]
        (run / "config.yaml").write_text(yaml.safe_dump(stored))

    def test_settings_that_a_run_is_older_than_have_their_defaults(self):
        run = make_run("outputs/a/1")
        self.before(run, "levels", "middle", "middle_exploration")
        assert plan_for("resume=auto", *SMALL).folder == run
        assert plan_for("resume=auto", *SMALL, "algo.levels=3").folder != run

    def test_a_setting_without_a_default_must_be_there(self):
        run = make_run("outputs/a/1")
        self.before(run, "sub")
        assert plan_for("resume=auto", *SMALL).folder != run

    def test_unreadable_runs_are_skipped(self):
        run = make_run("outputs/a/1")
        for name, text in (("2", "env: ["), ("3", "seed: 1"), ("4", HOSTILE["tag"]())):
            Path(f"outputs/a/{name}").mkdir()
            Path(f"outputs/a/{name}/config.yaml").write_text(text)
        assert plan_for("resume=auto", *SMALL).folder == run

    def test_earlier_runs_are_looked_for_in_output_root(self):
        run = make_run("elsewhere/a/1", "output_root=elsewhere")
        assert plan_for("resume=auto", *SMALL).folder != run
        assert plan_for("resume=auto", *SMALL, "output_root=elsewhere").folder == run

    def test_only_a_given_folder_is_considered(self):
        other, mine = make_run("outputs/a/1"), Path("mine")
        command = ["resume=auto", *SMALL, "hydra.run.dir=mine"]
        assert plan_for(*command, folder=mine).folder == mine
        assert not plan_for(*command, folder=mine).resumed and other.exists()
        mine.rmdir()
        make_run(mine)
        assert plan_for(*command, folder=mine).resumed
        with pytest.raises(SettingsError, match=r"(?s)differ from mine:.*seed: 0 -> 5"):
            plan_for(*command, "seed=5", folder=mine)
        config = compose_with_hydra(*command)
        assert find_same(config, Path("not there")) is None


class TestDatabases:
    """A run folder must not decide where measurements are sent."""

    def named(self, place):
        run = make_run("outputs/a/1", "logger=mlflow")
        file = run / "config.yaml"
        file.write_text(file.read_text().replace("sqlite:///outputs/mlflow.db", place))
        return run

    @pytest.mark.parametrize(
        "place", ["http://elsewhere:5000", "sqlite:////home/mine.db?x=y,z", "sqlite:///../mlflow.db"]
    )
    def test_a_database_that_the_command_does_not_name_is_refused(self, place):
        run = self.named(place)
        with pytest.raises(SettingsError, match=re.escape(f"got {place!r}, which stands in the run folder")) as refusal:
            plan_for(f"resume={run}")
        (remedy,) = re.findall(r"If it is yours, add (.*) to the command", str(refusal.value))
        assert plan_for(f"resume={run}", *shlex.split(remedy)).resumed

    def test_the_default_database_is_accepted(self):
        assert plan_for(f"resume={self.named('sqlite:///outputs/mlflow.db')}").resumed


class TestHostileRunFolders:
    @pytest.mark.parametrize("kind", HOSTILE)
    def test_nothing_is_executed_and_a_message_says_why(self, tmp_path, monkeypatch, kind):
        """What is not refused here is when it is built."""
        monkeypatch.setenv("HOSTILE_TARGET", "os.makedirs")
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / "config.yaml").write_text(HOSTILE[kind]().replace("MARKER", str(tmp_path / "marker")))
        (tmp_path / "run" / "run.json").write_text(
            json.dumps({"choices": {"env": "gridworld"}, "overrides": ["allowed_targets=[os.makedirs,os.system]"]})
        )
        if kind in REFUSED_WHEN_BUILT:
            assert plan_for("resume=run").resumed
        else:
            with pytest.raises(SettingsError) as refusal:
                plan_for("resume=run")
            assert len(str(refusal.value)) > 20 and str(refusal.value).count("\n") < 3
        assert not (tmp_path / "marker").exists()

    def test_only_the_command_can_allow_more_builders(self, tmp_path):
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / "config.yaml").write_text(HOSTILE["allowed by itself"]())
        with pytest.raises(SettingsError, match=r"add 'allowed_targets=\[os\.makedirs\]' to the command"):
            plan_for("resume=run")
        found = plan_for("resume=run", "allowed_targets=[os.makedirs]")
        assert found.config.allowed_targets == ["os.makedirs"]

    def test_a_run_folder_can_not_set_resume_override(self):
        run = make_run("outputs/a/1", "resume_override=true", "seed=1")
        with pytest.raises(SettingsError, match="seed: 1 -> 2"):
            plan_for(f"resume={run}", "seed=2")

    @pytest.mark.parametrize("content", ["", "[]", '{"choices": 3}', '{"choices": {"seed": "2"}}', "\x00"])
    def test_a_false_origin_changes_no_settings(self, content):
        run = make_run("outputs/a/1", "seed=1")
        (run / "run.json").write_text(content)
        if "seed" not in content:
            with pytest.raises(SettingsError, match="seed: 1 -> 2"):
                plan_for(f"resume={run}", "seed=2")
        assert plan_for(f"resume={run}").config.seed == 1


class TestDifferences:
    def compare(self, before, after):
        base = {"total_frames": 10, "resume": None, "algo": {"gamma": 0.9}}
        return differences(*(base | changes for changes in (before, after)))

    @pytest.mark.parametrize(
        ("before", "after", "found"),
        [
            ({}, {}, []),
            ({}, {"total_frames": 11}, []),
            ({}, {"total_frames": 9}, ["total_frames: 10 -> 9 (it can only be raised)"]),
            ({}, {"resume": "x", "resume_override": True, "checkpoint": {"keep_last": 3}, "output_root": "y"}, []),
            ({"seed": 1}, {"seed": 2}, ["seed: 1 -> 2"]),
            ({"seed": 1}, {}, ["seed: 1 -> (not set)"]),
            ({}, {"env": {"view": None}}, ["env.view: (not set) -> None"]),
            ({}, {"algo": {"gamma": 0.9, "tau": 1}}, ["algo.tau: (not set) -> 1"]),
            ({"algo": {}}, {"algo": {"gamma": 1}}, ["algo: {} -> (not set)", "algo.gamma: (not set) -> 1"]),
            ({"b": [1, 2]}, {"b": [1, 3]}, ["b: [1, 2] -> [1, 3]"]),
            ({"b": 1}, {"b": 1.0}, []),
            ({"algo": {"learning_rate_frames": 10}}, {"algo": {"learning_rate_frames": 99}, "total_frames": 99}, []),
            (
                {"algo": {"learning_rate_frames": 9}},
                {"algo": {"learning_rate_frames": 99}, "total_frames": 99},
                ["algo.learning_rate_frames: 9 -> 99"],
            ),
            ({"b": 10}, {"b": 99, "total_frames": 99}, ["b: 10 -> 99"]),
            ({"logger": {"loggers": [{"settings": {"seed": 1}}]}}, {"logger": {"loggers": [{"settings": {}}]}}, []),
            ({"logger": {"loggers": []}}, {"logger": {"loggers": [1]}}, ["logger.loggers: [] -> [1]"]),
        ],
    )
    def test_each_difference_is_a_line(self, before, after, found):
        assert self.compare(before, after) == found


class TestRecord:
    def test_a_run_records_its_origin(self, monkeypatch):
        monkeypatch.setattr("sys.argv", ["train.py", "seed=3"])
        run = make_run("outputs/a/1", "seed=3")
        origin = json.loads((run / "run.json").read_text())
        assert (
            origin["choices"]["algo"] == "v2"
            and "seed=3" in origin["overrides"]
            and origin["command"] == "train.py seed=3"
        )
        assert set(origin["versions"]) == {"hdrqn_torchrl", "torch", "torchrl", "tensordict"}
        assert origin["commit"] is None or re.fullmatch(r"[0-9a-f]{10}.*|.*", origin["commit"])
        text = (run / "config.yaml").read_text()
        assert "seed: 3" in text and "${" not in text and "learning_rate_frames: 800000" in text
        assert {path.name for path in run.iterdir()} == {"config.yaml", "run.json"}

    def test_a_resumed_run_keeps_its_origin_and_records_the_new_settings(self):
        run = make_run("outputs/a/1", "total_frames=100")
        origin = (run / "run.json").read_text()
        record(plan_for(f"resume={run}", "total_frames=200"))
        assert (run / "run.json").read_text() == origin
        assert OmegaConf.load(run / "config.yaml").total_frames == 200
        record(plan_for(f"resume={run}"))
        assert OmegaConf.load(run / "config.yaml").total_frames == 200

    def test_other_code_that_it_goes_on_with_is_recorded(self, monkeypatch):
        run = make_run("outputs/a/1", "total_frames=100")
        origin_of = json.loads((run / "run.json").read_text())
        for commit in ("89abcdef01", "89abcdef01", "fedcba9876"):
            monkeypatch.setattr(origin, "_commit", lambda commit=commit: commit)
            record(plan_for(f"resume={run}"))
        after = json.loads((run / "run.json").read_text())
        assert [each["commit"] for each in after.pop("resumed_with")] == ["89abcdef01", "fedcba9876"]
        assert after == origin_of

    def test_an_origin_that_says_nothing_does_not_keep_a_run_from_going_on(self):
        run = make_run("outputs/a/1", "total_frames=100")
        for content in ("[]", "{"):
            (run / "run.json").write_text(content)
            record(plan_for(f"resume={run}"))
            assert (run / "run.json").read_text() == content
        (run / "run.json").write_text('{"choices": {"algo": "v2"}, "resumed_with": 3}')
        record(plan_for(f"resume={run}"))
        assert len(json.loads((run / "run.json").read_text())["resumed_with"]) == 1

    def test_without_git_no_commit_is_recorded(self, monkeypatch):
        monkeypatch.setenv("PATH", "")
        assert origin._commit() is None
