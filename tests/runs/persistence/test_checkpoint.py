import io
import json
import os
import pickle
import re
import shutil
import zlib
from pathlib import Path

import pytest
import torch
from helpers import State, build, make_training, small_env
from torch import nn
from torchrl.checkpoint import Checkpoint, CheckpointError

from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints
from hdrqn_torchrl.runs.persistence.durable import verify
from hdrqn_torchrl.runs.persistence.weights import load_policy, load_weights, save_weights


def test_a_policy_comes_back_with_its_weights_and_schedules(tmp_path):
    torch.manual_seed(0)
    source, copy = build("v2", small_env(2)), build("v2", small_env(2))
    for level in source.explorations.values():
        level.step(12_345)
    path = f"{tmp_path}/checkpoints/last.safetensors"
    save_weights(source.policy, path)
    load_weights(copy.policy, path)
    wanted, found = source.policy.state_dict(), copy.policy.state_dict()
    assert wanted.keys() == found.keys() and all((wanted[key] == found[key]).all() for key in wanted)
    assert copy.explorations["sub"].epsilon == source.explorations["sub"].epsilon < 1.0
    copy.explorations["sub"].step(1)
    assert copy.explorations["sub"].frames == 12_346


def test_loaded_weights_are_those_that_the_learners_train(tmp_path):
    source, copy = build("v2", small_env(2)), build("v2", small_env(2))
    save_weights(source.policy, tmp_path / "weights.safetensors")
    load_weights(copy.policy, tmp_path / "weights.safetensors")
    stored = copy.learners["sub"].loss.value_network_params["network", "head", "streams", "weight"]
    assert (stored == source.policy.sub_controller.network.head.streams.weight).all()


def test_saving_replaces_the_file_and_leaves_nothing_else(tmp_path):
    path, module = tmp_path / "weights.safetensors", nn.Linear(2, 2)
    save_weights(module, path)
    with torch.no_grad():
        module.weight.fill_(3.0)
    save_weights(module, path)
    other = nn.Linear(2, 2)
    load_weights(other, path)
    assert (other.weight == 3.0).all()
    assert [file.name for file in tmp_path.iterdir()] == ["weights.safetensors"]


def test_a_failed_save_keeps_the_file_before(tmp_path):
    path, module = tmp_path / "weights.safetensors", nn.Linear(2, 2)
    save_weights(module, path)
    before = path.read_bytes()

    class Broken(nn.Linear):
        def state_dict(self):
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        save_weights(Broken(2, 2), path)
    assert path.read_bytes() == before


class TestFilesThatDoNotFit:
    def test_weights_of_other_sizes_are_refused(self, tmp_path):
        save_weights(nn.Linear(2, 2), tmp_path / "weights.safetensors")
        with pytest.raises(ValueError, match=r"weights\.safetensors does not fit this policy; .*settings of its run"):
            load_weights(nn.Linear(3, 2), tmp_path / "weights.safetensors")

    def test_weights_of_another_module_are_refused(self, tmp_path):
        save_weights(nn.LSTM(2, 2), tmp_path / "weights.safetensors")
        with pytest.raises(ValueError, match="does not fit this policy"):
            load_weights(nn.Linear(2, 2), tmp_path / "weights.safetensors")

    @pytest.mark.parametrize("content", [b"", b"no weights at all", bytes(64)], ids=["empty", "text", "zeros"])
    def test_another_kind_of_file_is_refused(self, tmp_path, content):
        path = tmp_path / "weights.safetensors"
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"weights\.safetensors must be a safetensors file, got .*; "):
            load_weights(nn.Linear(2, 2), path)

    def test_a_missing_file_is_refused(self, tmp_path):
        with pytest.raises(ValueError, match=r"path must name a weights file, got .*nothing\.safetensors; "):
            load_weights(nn.Linear(2, 2), tmp_path / "nothing.safetensors")


class TestDurability:
    def test_every_file_is_on_the_disk_before_the_checkpoint_has_its_name(self, tmp_path, monkeypatch):
        """In this order: all files and folders of the stage, the rename, the folder that holds the name."""
        events = []

        def synced(descriptor):
            events.append(("fsync", Path(f"/proc/self/fd/{descriptor}").readlink()))

        def replaced(source, target):
            events.append(("replace", Path(target)))
            replace(source, target)

        replace = os.replace
        monkeypatch.setattr(os, "fsync", synced)
        monkeypatch.setattr(os, "replace", replaced)
        path = Checkpoints(tmp_path).save({"a": nn.Linear(1, 1), "b": State({"x": 1})}, step=5)
        names = [kind for kind, _ in events]
        at = names.index("replace")
        assert events[at] == ("replace", path) and names.count("replace") == 1
        assert events[at + 1 :] == [("fsync", tmp_path)]
        stage = events[0][1]
        synced_before = {each.relative_to(stage).as_posix() for _, each in events[:at]}
        written = {each.relative_to(path).as_posix() for each in [path, *path.rglob("*")]}
        assert stage.parent == tmp_path and synced_before == written and len(written) == 10

    def test_a_module_can_be_loaded_by_name_from_a_checkpoint_with_more_in_it(self, tmp_path):
        checkpoints, copy = Checkpoints(tmp_path), nn.Linear(2, 2)
        source = nn.Linear(2, 2)
        path = checkpoints.save({"policy": source, "rest": State(3)}, step=1)
        checkpoints.load({"policy": copy}, path)
        assert (copy.weight == source.weight).all()


class TestRetention:
    def save(self, checkpoints, *entries):
        for entry in entries:
            step, score = entry if isinstance(entry, tuple) else (entry, None)
            checkpoints.save({"part": State(step)}, step=step, score=score)
        return sorted(int(path.name.removeprefix("checkpoint-")) for path in checkpoints.directory.iterdir())

    def test_the_newest_and_the_best_are_kept(self, tmp_path):
        checkpoints = Checkpoints(tmp_path)
        assert self.save(checkpoints, 10, (20, 0.5), (30, 0.2), 40, 50, 60) == [20, 50, 60]
        assert (checkpoints.best().name[-2:], checkpoints.newest().name[-2:]) == ("20", "60")
        assert self.save(checkpoints, (70, 0.9), 80, 90, 100) == [70, 90, 100]

    def test_keep_last_checkpoints_are_kept(self, tmp_path):
        assert self.save(Checkpoints(tmp_path, keep_last=4), *range(0, 100, 10)) == [60, 70, 80, 90]
        with pytest.raises(ValueError, match="keep_last must be >= 2, got 1; "):
            Checkpoints(tmp_path, keep_last=1)

    def test_without_scores_the_newest_is_the_best(self, tmp_path):
        checkpoints = Checkpoints(tmp_path)
        self.save(checkpoints, 10, 20)
        assert checkpoints.best() == checkpoints.newest()

    def test_the_best_is_the_later_of_equal_scores_and_may_be_negative(self, tmp_path):
        checkpoints = Checkpoints(tmp_path, keep_last=5)
        self.save(checkpoints, (10, -2.0), (20, -1.0), (30, -1.0), 40)
        assert checkpoints.best().name.endswith("30")

    def test_a_score_of_zero_counts(self, tmp_path):
        checkpoints = Checkpoints(tmp_path, keep_last=5)
        self.save(checkpoints, (10, -1.0), (20, 0.0), 30)
        assert checkpoints.best().name.endswith("20")

    def test_a_step_saved_twice_is_replaced(self, tmp_path):
        checkpoints, copy = Checkpoints(tmp_path), State()
        self.save(checkpoints, 10)
        path = checkpoints.save({"part": State("new")}, step=10)
        checkpoints.load({"part": copy}, path)
        assert copy.state == "new" and [each.name for each in tmp_path.iterdir()] == [path.name]

    def test_an_empty_or_missing_folder_has_no_checkpoints(self, tmp_path):
        for folder in (tmp_path, tmp_path / "missing"):
            assert Checkpoints(folder).newest() is None and Checkpoints(folder).best() is None
            Checkpoints(folder).clean_up()

    def test_going_back_removes_later_checkpoints(self, tmp_path):
        """Else it would be kept in place of what is saved from now on."""
        checkpoints = Checkpoints(tmp_path, keep_last=3)
        self.save(checkpoints, 10, 20, (30, 1.0))
        checkpoints.go_back_to(10)
        assert self.save(checkpoints, 15) == [10, 15]

    def test_going_back_removes_damaged_checkpoints_but_nothing_else(self, tmp_path):
        checkpoints = Checkpoints(tmp_path, keep_last=3)
        self.save(checkpoints, 10, 20)
        (tmp_path / "checkpoint-000000000010" / "manifest.json").unlink()
        names = ["checkpoint-000000000030-mine", "checkpoint-", "checkpoints", "notes"]
        for name in names:
            make_folder(tmp_path / name)
        with pytest.warns(UserWarning, match="is not complete: manifest"):
            checkpoints.go_back_to(20)
        assert {path.name for path in tmp_path.iterdir()} == {"checkpoint-000000000020", *names}


class TestMemories:
    """Components whose names begin with "memory-"."""

    def save(self, folder, replay, steps=(10, 20, 30)):
        checkpoints = Checkpoints(folder, replay=replay)
        for step in steps:
            checkpoints.save({"part": State(step), "memory-a": State(step), "memory-b": State(step)}, step=step)
        return checkpoints

    def load(self, checkpoints, step):
        parts = {name: State() for name in ("part", "memory-a", "memory-b")}
        missing = checkpoints.load(parts, checkpoints.directory / f"checkpoint-{step:012d}")
        return [part.state for part in parts.values()], missing

    @pytest.mark.parametrize(
        ("replay", "newest", "before"),
        [(True, [30, 30, 30], [20, 20, 20]), ("last", [30, 30, 30], [20, None, None]), (False, [30, None, None], None)],
    )
    def test_the_replay_argument_decides_which_checkpoints_hold_memories(self, tmp_path, replay, newest, before):
        checkpoints = self.save(tmp_path, replay)
        assert sorted(path.name[-2:] for path in tmp_path.iterdir()) == ["20", "30"]
        for step, expected in ((30, newest), (20, before or [20, None, None])):
            verify(tmp_path / f"checkpoint-{step:012d}")
            states, missing = self.load(checkpoints, step)
            assert states == expected
            assert missing == ([] if None not in expected else ["memory-a", "memory-b"])

    def test_only_memories_may_be_missing(self, tmp_path):
        checkpoints = self.save(tmp_path, True)
        with pytest.raises(CheckpointError, match="does not fit"):
            checkpoints.load({"other": State()}, checkpoints.newest())

    def test_the_best_checkpoint_stays_the_best_without_its_memories(self, tmp_path):
        checkpoints = Checkpoints(tmp_path, replay="last")
        for step, score in ((10, 0.5), (20, 0.1), (30, None), (40, None)):
            checkpoints.save({"part": State(step), "memory-a": State(step)}, step=step, score=score)
        assert checkpoints.best().name.endswith("10") and self.load(checkpoints, 10)[1] == ["memory-a", "memory-b"]

    def test_removing_memories_does_not_hide_damage(self, tmp_path):
        checkpoints = self.save(tmp_path, "last", steps=(10,))
        (damaged,) = tmp_path.glob("*/components/*-part/structure.json")
        damaged.write_text("20")
        self.save(tmp_path, "last", steps=(20,))
        with pytest.raises(CheckpointError, match="is damaged"):
            self.load(checkpoints, 10)

    @pytest.mark.parametrize("call", range(4))
    def test_a_kill_while_memories_are_removed_leaves_both_checkpoints_whole(self, tmp_path, monkeypatch, call):
        """Before the copy, before and between the renames, before what was replaced is removed."""
        checkpoints = self.save(tmp_path, "last", steps=(10,))
        calls = iter(range(9))

        def dying(function):
            def call_or_die(*args, **settings):
                if next(calls) == call:
                    raise KeyboardInterrupt
                return function(*args, **settings)

            return call_or_die

        monkeypatch.setattr("hdrqn_torchrl.runs.persistence.durable.shutil.copytree", dying(shutil.copytree))
        monkeypatch.setattr(Path, "rename", dying(Path.rename))
        monkeypatch.setattr("hdrqn_torchrl.runs.persistence.durable.remove_all", dying(shutil.rmtree))
        with pytest.raises(KeyboardInterrupt):
            self.save(tmp_path, "last", steps=(20,))
        monkeypatch.undo()
        checkpoints.clean_up()
        assert sorted(path.name[-2:] for path in tmp_path.iterdir()) == ["10", "20"]
        assert self.load(checkpoints, 10)[0][0] == 10 and self.load(checkpoints, 20)[0] == [20, 20, 20]

    def test_wrong_arguments_are_refused(self, tmp_path):
        with pytest.raises(ValueError, match=r"replay must be True, False or 'last', got 'first'; "):
            Checkpoints(tmp_path, replay="first")


def make_folder(path, files=("manifest.json",)):
    path.mkdir(parents=True)
    for name in files:
        (path / name).write_text("half")
    return path


class TestCleanUp:
    def test_remains_of_killed_writes_are_removed(self, tmp_path):
        checkpoints = Checkpoints(tmp_path)
        good = checkpoints.save({"part": State(1)}, step=10)
        make_folder(tmp_path / ".checkpoint-000000000020.stage-0123abcd")
        make_folder(tmp_path / ".checkpoint-000000000010.delete-0123abcd")
        make_folder(tmp_path / ".checkpoint-000000000010.backup-0123abcd")  # its replacement has the name already
        (tmp_path / ".checkpoint-000000000030.archive-0123abcd").write_text("half")
        other = make_folder(tmp_path / "mine")
        checkpoints.clean_up()
        assert sorted(tmp_path.iterdir()) == [good, other]

    def test_a_replacement_that_was_cut_between_its_two_renames_is_undone(self, tmp_path):
        checkpoints = Checkpoints(tmp_path)
        path = checkpoints.save({"part": State("before")}, step=10)
        path.rename(tmp_path / f".{path.name}.backup-0123abcd")
        make_folder(tmp_path / f".{path.name}.stage-0123abcd")
        assert checkpoints.newest() is None
        checkpoints.clean_up()
        copy = State()
        checkpoints.load({"part": copy}, checkpoints.newest())
        assert copy.state == "before" and list(tmp_path.iterdir()) == [path]

    def test_cleaning_up_does_not_follow_links(self, tmp_path):
        precious = make_folder(tmp_path / "precious")
        (tmp_path / "checkpoints").mkdir()
        (tmp_path / "checkpoints" / ".checkpoint-1.stage-0").symlink_to(precious)
        Checkpoints(tmp_path / "checkpoints").clean_up()
        assert not list((tmp_path / "checkpoints").iterdir()) and list(precious.iterdir())


@pytest.fixture(scope="module")
def two_saved(tmp_path_factory):
    """Checkpoints of a training at frames 96 and 128."""
    folder = tmp_path_factory.mktemp("run")
    make_training(folder, total_frames=128, evaluation_frames=1_000, checkpoint_frames=96).train()
    return folder / "checkpoints"


@pytest.fixture
def saved(two_saved, tmp_path):
    """A copy of them to be damaged, and the newest."""
    shutil.copytree(two_saved, tmp_path / "checkpoints")
    return Checkpoints(tmp_path / "checkpoints"), tmp_path / "checkpoints" / "checkpoint-000000000128"


def files_of(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def flip(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    file.write_bytes(content)


DAMAGES = {
    "missing": lambda file: file.unlink(),
    "empty": lambda file: file.write_bytes(b""),
    "half": lambda file: file.write_bytes(file.read_bytes()[: file.stat().st_size // 2]),
    "one byte less": lambda file: file.write_bytes(file.read_bytes()[:-1]),
    "one bit": flip,
    "another's": lambda file: file.write_bytes(b"PK\x03\x04 something else"),
}


class TestDamage:
    @pytest.mark.parametrize("damage", DAMAGES)
    def test_damage_to_any_file_is_found_and_the_checkpoint_before_is_taken(self, saved, damage):
        checkpoints, newest = saved
        before, backup = newest.with_name("checkpoint-000000000096"), newest.with_name("backup")
        names = files_of(newest)
        assert len(names) == 2 + 2 * 9 and checkpoints.newest() == newest
        shutil.copytree(newest, backup)
        for name in names:
            DAMAGES[damage](newest / name)
            with pytest.raises(CheckpointError, match=re.escape(str(newest))) as refusal:
                verify(newest)
            assert name in str(refusal.value) or name == "checksums.json"
            with pytest.warns(UserWarning, match=re.escape(f"{newest} is")):
                assert checkpoints.newest() == before
            (newest / name).unlink(missing_ok=True)
            shutil.copyfile(backup / name, newest / name)
        assert checkpoints.newest() == newest

    def test_a_damaged_best_checkpoint_is_skipped(self, saved):
        checkpoints, newest = saved
        best = checkpoints.save({"part": State(1)}, step=64, score=1.0)
        assert checkpoints.best() == best
        (best / "manifest.json").write_text("{}")
        with pytest.warns(UserWarning, match="is damaged: manifest.json"):
            assert checkpoints.best() == newest

    def test_if_all_are_damaged_nothing_starts_from_scratch(self, saved):
        checkpoints, newest = saved
        for path in newest.parent.iterdir():
            (path / "manifest.json").unlink()
        with pytest.warns(UserWarning), pytest.raises(CheckpointError, match=r"no checkpoint in .* can be loaded; "):
            checkpoints.newest()

    def test_a_training_that_goes_on_from_the_one_before_removes_the_damaged_one(self, saved, tmp_path):
        checkpoints, newest = saved
        (newest / "checksums.json").unlink()
        trainer = make_training(tmp_path, total_frames=128, evaluation_frames=1_000)
        with pytest.warns(UserWarning):
            trainer.resume(trainer.checkpoints.newest())
        assert trainer.frames == 96 and not newest.exists()
        trainer.train()
        assert checkpoints.newest() == newest

    @pytest.mark.parametrize("kind", ["folder", "file", "missing", "torchrl", "torch"])
    def test_something_other_than_a_checkpoint_is_refused(self, saved, tmp_path, kind):
        checkpoints, _ = saved
        path = tmp_path / "foreign"
        if kind == "folder":
            make_folder(path)
        elif kind == "file":
            path.write_text("text")
        elif kind == "torchrl":
            Checkpoint(part=nn.Linear(1, 1)).save(path)
        elif kind == "torch":
            torch.save({"weight": torch.ones(1)}, path)
        with pytest.raises(CheckpointError, match=r"foreign is not a checkpoint of this package \(checksums\.json: "):
            checkpoints.load({"part": State()}, path)

    def test_a_checkpoint_of_another_training_is_refused(self, saved, tmp_path):
        _, newest = saved
        for changes in ({"name": "drqn"}, {"learner": {"capacity": 200}, "name": "v1"}):
            trainer = make_training(tmp_path / "other", **changes)
            with pytest.raises(CheckpointError, match="000000128 does not fit; it must be loaded with the settings"):
                trainer.resume(newest)


class Evil:
    """Its unpickling leaves a mark."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


def forge(checkpoint, name, content):
    """Puts a file into a checkpoint, with a checksum that fits."""
    (checkpoint / name).parent.mkdir(parents=True, exist_ok=True)
    (checkpoint / name).write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    sums = json.loads((checkpoint / "checksums.json").read_text())
    data = (checkpoint / name).read_bytes()
    sums[name] = [len(data), zlib.crc32(data)]
    (checkpoint / "checksums.json").write_text(json.dumps(sums))


def change_manifest(checkpoint, change):
    manifest = json.loads((checkpoint / "manifest.json").read_text())
    change(manifest)
    forge(checkpoint, "manifest.json", manifest)


class TestHostileCheckpoints:
    """Checkpoints whose checksums fit, written by an attacker."""

    @pytest.fixture
    def hostile(self, tmp_path):
        checkpoints = Checkpoints(tmp_path / "checkpoints")
        return checkpoints, checkpoints.save({"policy": nn.Linear(2, 2)}, step=1)

    def refused(self, checkpoints, path):
        with pytest.raises(CheckpointError, match=re.escape(str(path))) as refusal:
            checkpoints.load({"policy": nn.Linear(2, 2)}, path)
        with pytest.raises(ValueError, match="checkpoint can't be loaded: "):
            load_policy(nn.Linear(2, 2), checkpoints.directory, str(path))
        return str(refusal.value)

    def test_a_marker_would_appear_if_anything_were_unpickled(self, tmp_path):
        pickle.loads(pickle.dumps(Evil(tmp_path / "marker")))
        assert (tmp_path / "marker").exists()

    @pytest.mark.parametrize("save", ["pickle", "torch"])
    @pytest.mark.parametrize(
        "name",
        ["tensors.safetensors", "structure.json", "state.pt", "../../manifest.json"],
        ids=lambda name: Path(name).name,
    )
    def test_nothing_is_unpickled(self, hostile, tmp_path, save, name):
        checkpoints, path = hostile
        buffer = io.BytesIO()
        (torch.save if save == "torch" else pickle.dump)(Evil(tmp_path / "marker"), buffer)
        place = os.path.normpath(f"components/0000-policy/{name}")
        forge(path, place, buffer.getvalue())
        if name == "state.pt":  # as TorchRL's own adapter reads it
            change_manifest(
                path, lambda manifest: manifest["components"]["policy"].update(adapter="torchrl.state_dict")
            )
        self.refused(checkpoints, path)
        assert not (tmp_path / "marker").exists()

    @pytest.mark.parametrize(
        "manifest",
        [[], "text", 3, None, {}, {"format": "torchrl.checkpoint"}, {"format": "other", "format_version": 1}],
        ids=str,
    )
    def test_a_malformed_manifest_is_refused(self, hostile, manifest):
        checkpoints, path = hostile
        forge(path, "manifest.json", manifest)
        assert "is not a checkpoint of this package (manifest.json: " in self.refused(checkpoints, path)

    @pytest.mark.parametrize("place", ["../../../elsewhere", "/etc", "components/../../.."])
    def test_a_manifest_that_leads_elsewhere_is_refused(self, hostile, place):
        checkpoints, path = hostile
        change_manifest(path, lambda manifest: manifest["components"]["policy"].update(path=place))
        assert "Unsafe archive member path" in self.refused(checkpoints, path)

    def test_checksums_of_files_elsewhere_are_refused(self, hostile, tmp_path):
        checkpoints, path = hostile
        (tmp_path / "secret").write_text("secret")
        forge(path, "../../secret", b"secret")
        assert "../../secret lies outside of it" in self.refused(checkpoints, path)

    def test_a_link_to_a_file_elsewhere_is_refused(self, hostile, tmp_path):
        checkpoints, path = hostile
        file = path / "components" / "0000-policy" / "tensors.safetensors"
        file.rename(tmp_path / "elsewhere")
        file.symlink_to(tmp_path / "elsewhere")
        assert "got a symbolic link" in self.refused(checkpoints, path)

    def test_a_file_without_a_checksum_is_refused(self, hostile):
        checkpoints, path = hostile
        sums = json.loads((path / "checksums.json").read_text())
        del sums["components/0000-policy/tensors.safetensors"]
        (path / "checksums.json").write_text(json.dumps(sums))
        assert "is not complete: checksums.json lacks files of components/0000-policy" in self.refused(
            checkpoints, path
        )

    @pytest.mark.parametrize(
        "structure",
        [
            [],
            {},
            3,
            None,
            {"call": "os.system"},
            {"tensor": "missing"},
            {"tensor": []},
            {"dict": [["weight", {"tensor": "weight"}]]},
            {"dict": [["weight", {"tensor": "weight"}], ["bias", {"tensor": "weight"}]]},
            {"dict": [[[1], 2]]},
            {"dict": 5},
            {"size": ["a"]},
            {"tensordict": {"a": {"tensor": "weight"}}, "batch_size": [17], "names": [None]},
            {"tensordict": {}},
            {"tuple": {"__reduce__": ["os.system", "true"]}},
        ],
        ids=str,
    )
    def test_a_meaningless_structure_is_refused(self, hostile, structure):
        checkpoints, path = hostile
        forge(path, "components/0000-policy/structure.json", structure)
        self.refused(checkpoints, path)

    def test_a_structure_that_is_too_deep_is_refused(self, hostile):
        checkpoints, path = hostile
        forge(path, "components/0000-policy/structure.json", b'{"list":[' * 50_000 + b"]}" * 50_000)
        self.refused(checkpoints, path)

    def test_a_manifest_and_checksums_that_are_too_deep_are_refused(self, hostile):
        checkpoints, path = hostile
        forge(path, "manifest.json", b"[" * 100_000 + b"]" * 100_000)
        self.refused(checkpoints, path)
        (path / "checksums.json").write_bytes(b"[" * 100_000 + b"]" * 100_000)
        self.refused(checkpoints, path)


class TestLoadPolicy:
    def test_a_policy_is_loaded_from_the_best_the_last_or_a_path(self, tmp_path):
        checkpoints, policies = Checkpoints(tmp_path), [nn.Linear(1, 1) for _ in range(3)]
        paths = [
            checkpoints.save({"policy": policy}, step=step, score=score)
            for step, (policy, score) in enumerate(zip(policies, (0.1, 0.9, None), strict=True))
        ]
        save_weights(policies[0], tmp_path / "weights.safetensors")
        expected = {"best": 1, "last": 2, str(paths[1]): 1, str(tmp_path / "weights.safetensors"): 0}
        for which, number in expected.items():
            copy = nn.Linear(1, 1)
            load_policy(copy, tmp_path, which)
            assert (copy.weight == policies[number].weight).all(), which

    @pytest.mark.parametrize(
        ("which", "message"),
        [
            ("best", "checkpoint=best is not in .*: the run has not saved anything yet"),
            ("last", "checkpoint=last is not in .*: the run has not saved anything yet"),
            ("nowhere", "checkpoint can't be loaded: nowhere is not a checkpoint of this package"),
        ],
    )
    def test_a_missing_checkpoint_is_reported(self, tmp_path, which, message):
        with pytest.raises(ValueError, match=message):
            load_policy(nn.Linear(1, 1), tmp_path / "checkpoints", which)

    def test_a_checkpoint_that_does_not_fit_is_refused(self, tmp_path):
        Checkpoints(tmp_path).save({"policy": nn.Linear(2, 2)}, step=1)
        with pytest.raises(ValueError, match=r"checkpoint can't be loaded: .* does not fit; "):
            load_policy(nn.Linear(3, 2), tmp_path)


def test_whoever_may_read_the_rest_of_a_checkpoint_may_read_its_tensors(tmp_path):
    path = Checkpoints(tmp_path).save({"module": nn.Linear(2, 1)}, step=1)
    assert len({file.stat().st_mode for file in path.rglob("*") if file.is_file()}) == 1
