"""Files of a run folder that came from somebody else."""

import json
import os
import time

import pytest

from hdrqn_torchrl.runs.persistence.files import (
    LIMITS,
    RunFileError,
    check_file,
    open_descriptor,
    open_file,
    read_bytes,
    read_json,
    read_text,
    remove,
    replaced,
    write_whole,
)


@pytest.fixture
def secret(tmp_path):
    """A file outside of the run folder; it stays as it is."""
    file = tmp_path / "secret.json"
    file.write_text('"secret"')
    yield file
    assert file.read_text() == '"secret"'


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "run").mkdir()
    return tmp_path / "run"


def put(kind, place, secret):
    """Puts something at ``place`` that is no regular file."""
    if kind == "pipe":
        os.mkfifo(place)
    elif kind == "folder":
        place.mkdir()
    else:
        targets = {"link": secret, "device": "/dev/zero", "dangling": secret.with_name("new"), "itself": place}
        place.symlink_to(targets[kind])


KINDS = ("link", "device", "dangling", "itself", "pipe", "folder")
WORD = {"pipe": "a pipe", "folder": "a folder"}
USES = {
    "read": lambda path: read_text(path),
    "append": lambda path: open_file(path, "a"),
    "open": lambda path: open_descriptor(path, os.O_RDWR | os.O_CREAT),
    "remove": lambda path: remove(path),
    "json": lambda path: read_json(path),
}


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("kind", KINDS)
def test_only_regular_files_are_opened_or_removed(folder, secret, kind, use):
    place, started = folder / "file.json", time.monotonic()
    put(kind, place, secret)
    with pytest.raises(RunFileError, match=f"^{place} must be .* got {WORD.get(kind, 'a symbolic link')}; .*[.]$"):
        USES[use](place)
    assert time.monotonic() - started < 1 and not secret.with_name("new").exists()
    assert place.is_symlink() or place.exists()


def test_a_hard_link_to_a_file_elsewhere_is_not_written_to(folder, secret):
    os.link(secret, folder / "file.json")
    for use in ("append", "open"):
        with pytest.raises(RunFileError, match=r"got a file with other names \(hard links\)"):
            USES[use](folder / "file.json")
    write_whole(folder / "file.json", "1")
    assert read_json(folder / "file.json") == 1


def test_the_run_folder_may_be_a_link_but_no_folder_inside_it(folder, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "file.json").write_text("3")
    (folder / "checkpoints").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "alias").symlink_to(folder)
    for run in (folder, tmp_path / "alias"):
        with pytest.raises(RunFileError, match=r"checkpoints must be .* got a symbolic link"):
            read_json(run / "checkpoints" / "file.json", root=run)
    (folder / "checkpoints").unlink()
    (folder / "checkpoints").mkdir()
    write_whole(folder / "checkpoints" / "file.json", "5")
    assert read_json(tmp_path / "alias" / "checkpoints" / "file.json", root=tmp_path / "alias") == 5


def test_a_file_outside_the_root_is_refused(folder, secret):
    with pytest.raises(RunFileError, match="must lie in"):
        check_file(secret, root=folder)


@pytest.mark.parametrize("size", [LIMITS[".json"] + 1, 200 << 30])
def test_a_file_larger_than_any_run_writes_is_not_read(folder, size):
    with (folder / "run.json").open("wb") as file:
        file.truncate(size)
    started = time.monotonic()
    with pytest.raises(RunFileError, match=f"at most 16,777,216 bytes, got {size:,}"):
        read_json(folder / "run.json")
    assert time.monotonic() - started < 1


def test_a_file_of_the_largest_allowed_size_is_read(folder):
    (folder / "file").write_bytes(bytes(10))
    assert read_bytes(folder / "file", limit=10) == bytes(10)
    with pytest.raises(RunFileError, match="at most 9 bytes, got 10"):
        read_bytes(folder / "file", limit=9)


@pytest.mark.parametrize(
    "text", ["", "{", "[" * 100_000 + "]" * 100_000, "9" * 5000, "\udcff"], ids=lambda text: text[:3]
)
def test_malformed_json_is_reported_in_one_sentence(folder, text):
    (folder / "run.json").write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(RunFileError, match=r"run\.json must be a JSON file, got something else \(.*\)\.$"):
        read_json(folder / "run.json")


def test_a_missing_file_can_be_created_or_removed_but_not_read(folder):
    for use in (read_text, read_json):
        with pytest.raises(FileNotFoundError):
            use(folder / "run.json")
    remove(folder / "run.json")
    os.close(open_descriptor(folder / ".lock", os.O_RDWR | os.O_CREAT))
    with open_file(folder / "rows", "a") as file:
        file.write("a")
    with open_file(folder / "rows", "a") as file:
        file.write("b")
    assert read_text(folder / "rows", limit=9) == "ab" and (folder / ".lock").read_bytes() == b""


class TestWriting:
    @pytest.mark.parametrize("kind", ["link", "device", "dangling", "pipe"])
    @pytest.mark.parametrize("name", ["run.json", "run.partial.json"])
    def test_a_link_or_pipe_in_the_way_is_replaced_and_not_followed(self, folder, secret, kind, name):
        put(kind, folder / name, secret)
        write_whole(folder / "run.json", "[]")
        assert (folder / "run.json").read_text() == "[]" and not (folder / "run.json").is_symlink()
        assert {path.name for path in folder.iterdir()} == {"run.json"} and not secret.with_name("new").exists()

    def test_a_failed_write_keeps_the_file_before(self, folder):
        write_whole(folder / "run.json", json.dumps("before"))
        with pytest.raises(ZeroDivisionError), replaced(folder / "run.json") as partial:
            partial.write_text("half")
            _ = 1 / 0
        assert read_json(folder / "run.json") == "before" and len(list(folder.iterdir())) == 1

    def test_a_file_behind_a_link_is_not_written(self, folder, tmp_path):
        (tmp_path / "elsewhere").mkdir()
        (folder / "evaluations").symlink_to(tmp_path / "elsewhere")
        with pytest.raises(RunFileError, match=r"evaluations must be .* got a symbolic link"):
            write_whole(folder / "evaluations" / "greedy.json", "1", root=folder)
        assert not list((tmp_path / "elsewhere").iterdir())
