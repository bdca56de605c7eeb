"""Malicious run folders: programs refuse each at once with a clear error and touch nothing outside."""

import json
import os
import shutil
import signal
import struct
import time
import zlib
from contextlib import ExitStack, contextmanager

import pytest
import torch
import yaml
from processes import run_script
from programs import TINY, TINY_HDRQN
from safetensors.torch import load_file, save_file
from torchrl.checkpoint import CheckpointError

from hdrqn_torchrl.analysis import archives
from hdrqn_torchrl.cli import evaluate, plot, study_runs, train
from hdrqn_torchrl.cli.configuration import RunError
from hdrqn_torchrl.cli.resuming import Plan
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.reading import read_config
from hdrqn_torchrl.runs.settings.run_settings import check

BIG = 200 << 30


@pytest.fixture(scope="session")
def valid(tmp_path_factory):
    """A small run of train.py, with two checkpoints and a memory drawn from by priority."""
    folder = tmp_path_factory.mktemp("valid")
    learners = [f"algo.{level}.{setting}" for level in ("sub", "meta") for setting in ("priority_exponent=0.9",)]
    code, _, told = run_script(folder, *TINY, *TINY_HDRQN, *learners, "logger=csv", "hydra.run.dir=run")
    assert code == 0, told
    return folder / "run"


@pytest.fixture
def run(valid, tmp_path, monkeypatch):
    """A copy of the run, next to files that must not change."""
    outside = tmp_path / "outside"
    (outside / "checkpoint-000000000001").mkdir(parents=True)
    (outside / "checkpoint-000000000001" / "file").write_text("precious")
    (outside / "precious.csv").write_text("frames,greedy/return\n0,31337\n")
    before = snapshot(outside)
    shutil.copytree(valid, tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    yield tmp_path / "run"
    assert snapshot(outside) == before


def snapshot(folder):
    files = {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob("*")}, files


@contextmanager
def at_once(seconds=5):
    """Interrupts code that hangs, and fails if it takes too long."""

    def give_up(*_):
        raise AssertionError("it hangs")

    before, started = signal.signal(signal.SIGALRM, give_up), time.monotonic()
    signal.alarm(4 * seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    assert time.monotonic() - started < seconds


def evaluated(run):
    evaluate.evaluate_run(evaluate.Settings(run=str(run), episodes=4, num_envs=4, checkpoint="last"))


def resumed(run):
    config = read_config(run)
    check(config)
    train.train(Plan(run, config, {}, resumed=True))


def plotted(run):
    plot.run(plot.Settings(runs=str(run), out=str(run.parent / "figure.png")))


def reported(run):
    with ExitStack() as stack:
        study_runs.read_runs([str(run)], stack)


READERS = {"evaluate": evaluated, "resume": resumed, "plot": plotted, "report": reported}


def newest(run):
    return max((run / "checkpoints").glob("checkpoint-*"))


def sealed(checkpoint, name, content=None):
    """Puts a file into a checkpoint, with a checksum that fits."""
    if content is not None:
        (checkpoint / name).write_bytes(content)
    sums, data = json.loads((checkpoint / "checksums.json").read_text()), (checkpoint / name).read_bytes()
    sums[name] = [len(data), zlib.crc32(data)]
    (checkpoint / "checksums.json").write_text(json.dumps(sums))


def part(checkpoint, name):
    manifest = json.loads((checkpoint / "manifest.json").read_text())
    return checkpoint / manifest["components"][name]["path"]


def tensors(component, change):
    """Changes stored tensors in all checkpoints; checksums fit."""

    def attack(run):
        for checkpoint in (run / "checkpoints").iterdir():
            file = part(checkpoint, component) / "tensors.safetensors"
            changed = load_file(file)
            change(changed)
            save_file({name: each.clone().contiguous() for name, each in changed.items()}, file)
            sealed(checkpoint, str(file.relative_to(checkpoint)))

    return attack


def structure(component, change):
    """Changes numbers in all checkpoints; checksums fit."""

    def attack(run):
        for checkpoint in (run / "checkpoints").iterdir():
            file = part(checkpoint, component) / "structure.json"
            text = json.loads(file.read_text())
            change(dict(text["dict"]), text)
            sealed(checkpoint, str(file.relative_to(checkpoint)), json.dumps(text).encode())

    return attack


def set_number(*path, value):
    def change(_, node):
        for name in path[:-1]:
            node = dict(node["dict"])[name]
        next(item for item in node["dict"] if item[0] == path[-1])[1] = value

    return change


def settings(**changes):
    def attack(run):
        found = yaml.safe_load((run / "config.yaml").read_text())
        for path, value in changes.items():
            node = found
            *parents, last = path.split("__")
            for name in parents:
                node = node[name]
            node[last] = value
        (run / "config.yaml").write_text(yaml.safe_dump(found))

    return attack


def link(name, target):
    def attack(run):
        place = run / name
        if place.is_dir() and not place.is_symlink():
            shutil.rmtree(place)
        place.unlink(missing_ok=True)
        place.symlink_to(target if target.startswith("/") else run.parent / "outside" / target)

    return attack


def pipe(name):
    def attack(run):
        (run / name).unlink(missing_ok=True)
        os.mkfifo(run / name)

    return attack


def sparse(name):
    def attack(run):
        with (run / name).open("wb") as file:
            file.truncate(BIG)

    return attack


def text(name, content):
    return lambda run: (run / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def in_checkpoints(attack_of):
    """Applies the same change to every checkpoint."""
    return lambda run: [attack_of(str(path.relative_to(run)))(run) for path in (run / "checkpoints").iterdir()]


def hollow(run):
    """A file of 200 GB that its checksums and its header agree with."""
    for checkpoint in (run / "checkpoints").iterdir():
        file = part(checkpoint, "policy") / "tensors.safetensors"
        header = json.dumps({"a": {"dtype": "U8", "shape": [BIG], "data_offsets": [0, BIG]}}).encode()
        file.write_bytes(struct.pack("<Q", len(header)) + header)
        os.truncate(file, 8 + len(header) + BIG)
        sums = json.loads((checkpoint / "checksums.json").read_text())
        sums[str(file.relative_to(checkpoint))] = [8 + len(header) + BIG, 0]
        (checkpoint / "checksums.json").write_text(json.dumps(sums))


def header(length, content=b""):
    def attack(run):
        for checkpoint in (run / "checkpoints").iterdir():
            file = part(checkpoint, "policy") / "tensors.safetensors"
            sealed(checkpoint, str(file.relative_to(checkpoint)), struct.pack("<Q", length) + content)

    return attack


def first(name_part):
    """The stored tensor whose name ends like this."""
    return lambda stored: next(name for name in sorted(stored) if name.endswith(name_part))


def fill(ending, value, *, all_of_it=False):
    def change(stored):
        stored[first(ending)(stored)].view(-1)[: None if all_of_it else 1] = value

    return change


def resize(ending, shape):
    def change(stored):
        name = first(ending)(stored)
        stored[name] = torch.zeros(shape, dtype=stored[name].dtype)

    return change


NAN = float("nan")
ROWS = ("buffer", "_storage", "rows")
DEEP = "[" * 100_000 + "]" * 100_000
ATTACKS = {
    # links
    "config.yaml is a link": (link("config.yaml", "precious.csv"), ("evaluate", "resume", "plot")),
    "config.yaml is endless": (link("config.yaml", "/dev/zero"), ("evaluate", "resume")),
    "metrics.csv is a link": (link("metrics.csv", "precious.csv"), ("resume", "plot", "report")),
    "metrics.csv is endless": (link("metrics.csv", "/dev/zero"), ("resume", "plot")),
    "summary.json is a link": (link("summary.json", "precious.csv"), ("resume", "plot")),
    "error.txt is a link": (link("error.txt", "precious.csv"), ("resume",)),
    ".lock is a link": (link(".lock", "precious.csv"), ("resume",)),
    "checkpoints is a link": (link("checkpoints", "."), ("evaluate", "resume")),
    "a checkpoint is a link": (in_checkpoints(lambda name: link(name, ".")), ("evaluate", "resume")),
    "checksums are a link": (in_checkpoints(lambda name: link(f"{name}/checksums.json", "/dev/zero")), ("evaluate",)),
    "a manifest is a link": (in_checkpoints(lambda name: link(f"{name}/manifest.json", "/dev/zero")), ("evaluate",)),
    # pipes
    "config.yaml is a pipe": (pipe("config.yaml"), ("evaluate", "resume", "plot")),
    "metrics.csv is a pipe": (pipe("metrics.csv"), ("resume", "plot", "report")),
    "summary.json is a pipe": (pipe("summary.json"), ("resume", "plot")),
    "run.json is a pipe": (pipe("run.json"), ("resume",)),
    ".lock is a pipe": (pipe(".lock"), ("resume",)),
    "checksums are a pipe": (in_checkpoints(lambda name: pipe(f"{name}/checksums.json")), ("evaluate", "resume")),
    "a manifest is a pipe": (in_checkpoints(lambda name: pipe(f"{name}/manifest.json")), ("evaluate",)),
    # sizes
    "config.yaml of 200 GB": (sparse("config.yaml"), ("evaluate", "resume", "plot")),
    "metrics.csv of 200 GB": (sparse("metrics.csv"), ("resume", "plot")),
    "summary.json of 200 GB": (sparse("summary.json"), ("plot", "report")),
    "checksums of 200 GB": (in_checkpoints(lambda name: sparse(f"{name}/checksums.json")), ("evaluate",)),
    "a manifest of 200 GB": (in_checkpoints(lambda name: sparse(f"{name}/manifest.json")), ("evaluate", "resume")),
    "tensors of 200 GB": (hollow, ("evaluate", "resume")),
    "a header longer than the file": (header(1 << 40), ("evaluate",)),
    "a header of no JSON": (header(4, b"????"), ("evaluate",)),
    "a header of lists": (header(2 * len(DEEP), (DEEP * 2).encode()), ("evaluate",)),
    "a header that promises more": (
        header(64, b'{"a":{"dtype":"U8","shape":[9],"data_offsets":[0,9]}}'.ljust(64)),
        ("evaluate",),
    ),
    # text
    "nested settings": (text("config.yaml", "a: " + DEEP), ("evaluate", "resume", "plot")),
    "nested sums": (in_checkpoints(lambda name: text(f"{name}/checksums.json", DEEP)), ("evaluate", "resume")),
    "a nested summary": (text("summary.json", DEEP), ("plot",)),
    "metrics with a million columns": (text("metrics.csv", "a," * 1_000_000 + "b\n"), ("plot",)),
    "metrics without numbers": (text("metrics.csv", "frames\nx\n"), ("plot",)),
    "metrics without frames": (text("metrics.csv", "frames,greedy/return\nnan,1\ninf,1\n"), ("plot",)),
    "bytes that are no text": (text("metrics.csv", b"\xff\xfe\n\x00\n"), ("plot", "resume")),
    # settings
    "a thousand million worlds": (settings(env__num_envs=10**9), ("resume",)),
    "a thousand million steps": (settings(env__max_steps=10**9), ("evaluate", "resume")),
    "a thousand million predictions": (settings(algo__prediction_steps=10**9), ("evaluate", "resume")),
    "a huge network": (settings(network__hidden_size=10**6), ("evaluate", "resume")),
    "a huge memory": (settings(algo__sub__capacity=10**12), ("evaluate", "resume")),
    "a huge map": (settings(env__layout=["#" * 300] + ["#" + " " * 298 + "#"] * 300), ("evaluate", "resume")),
    "worlds that are text": (settings(env__num_goals="two"), ("evaluate",)),
    # states
    "moments of other shapes": (
        tensors("learner-sub", resize("optimizer/state/0/exp_avg", [1])), ("resume",)
    ),
    "an agent beyond the map": (tensors("collector", fill("base_env/agent", 10**6)), ("resume",)),
    "objects beyond the map": (tensors("collector", fill("base_env/objects", -5)), ("resume",)),
    "an unknown cell code": (tensors("collector", fill("carrier/observation", 250)), ("resume",)),
    "an unknown cell code in the memory": (tensors("memory-sub", fill("stored/observation", 250)), ("resume",)),
    "an unknown action in the memory": (tensors("memory-sub", fill("stored/action", 10**9)), ("resume",)),
    "an unknown subgoal in the memory": (tensors("memory-meta", fill("stored/subgoal", -7)), ("resume",)),
    "a priority that is none": (tensors("memory-sub", fill("_sampler/priorities", NAN, all_of_it=True)), ("resume",)),
    "priorities of another memory": (tensors("memory-sub", resize("_sampler/priorities", [3])), ("resume",)),
    "weights of another network": (tensors("policy", resize("bias", [77])), ("evaluate", "resume")),
    "a million million rows": (structure("memory-sub", set_number(*ROWS, value=10**12)), ("resume",)),
    "rows that are negative": (structure("memory-sub", set_number(*ROWS, value=-1)), ("resume",)),
    "updates that are owed": (structure("learner-sub", set_number("updates", value=-(10**12))), ("resume",)),
    "updates that are text": (structure("learner-sub", set_number("updates", value="many")), ("resume",)),
    "frames that are no number": (structure("trainer", set_number("frames", value=None)), ("resume",)),
    "rows of metrics that are negative": (structure("logger", set_number("csv", "rows", value=-5)), ("resume",)),
    "another place in numpy's table": (tensors("random", resize("numpy/1", [7])), ("resume",)),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "reader"),
    [(name, reader) for name, (_, readers) in ATTACKS.items() for reader in readers],
)
@pytest.mark.filterwarnings("ignore:.*is skipped")
def test_programs_refuse_a_hostile_run_in_one_sentence(run, capsys, name, reader):
    ATTACKS[name][0](run)
    with at_once(), pytest.raises((SettingsError, RunError, CheckpointError)) as refusal:
        READERS[reader](run)
    told = str(refusal.value) + capsys.readouterr().err
    assert "Traceback" not in told and str(refusal.value).count("\n") == 0 and len(str(refusal.value)) > 20


def test_programs_accept_the_run_before_it_is_changed(run):
    for reader in READERS.values():
        reader(run)


@pytest.mark.parametrize("name", ["error.txt", "curves.png", "metrics.partial.csv"])
def test_obstacles_to_a_training_are_reported_or_replaced(run, name):
    link(name, "precious.csv")(run)
    try:
        resumed(run)
    except (SettingsError, RunError) as error:
        assert "symbolic link" in str(error)


def test_a_label_with_broken_mathtext_is_drawn_as_plain_text(run):
    settings(env__layout="$\\frac{$")(run)
    with at_once(30):
        plot.run(plot.Settings(runs=str(run), out=str(run.parent / "figure.png"), by="env.layout"))
        plot.run(plot.Settings(runs=str(run), out=str(run.parent / "bars.png"), by="env.layout", kind="bars"))


def test_folders_with_circular_links_are_visited_once(run):
    for name in ("a", "b", "c"):
        (run / name).symlink_to(run)
    with at_once(10):
        plotted(run)


def archive_of(members, path):
    import io
    import tarfile

    with tarfile.open(path, "w:xz") as archive:
        for name, content in members.items():
            member = tarfile.TarInfo(name)
            if isinstance(content, str):
                member.type, member.linkname = tarfile.SYMTYPE, content
                archive.addfile(member)
            else:
                member.size = len(content)
                archive.addfile(member, io.BytesIO(content))
    return path


@pytest.mark.parametrize(
    "members",
    [
        {"000/metrics.csv": "/etc/passwd"},
        {"000/metrics.csv": "../../outside/precious.csv"},
        {"../metrics.csv": b"frames\n"},
        {"/tmp/metrics.csv": b"frames\n"},
        {"000/evil.py": b"print()"},
        {"000/../../metrics.csv": b"frames\n"},
        {"000/metrics.csv": bytes(3 << 20)},
        {"000/" + "x" * 5_000_000 + "/metrics.csv": b""},
    ],
    ids=lambda members: str(list(members))[:30],
)
def test_an_archive_holds_only_files_of_runs(run, monkeypatch, members):
    monkeypatch.setattr(archives, "LARGEST_ARCHIVE", 2 << 20)
    path = archive_of(members, run.parent / "runs.tar.xz")
    with (
        at_once(),
        ExitStack() as stack,
        pytest.raises(SettingsError, match=r"runs must name folders or readable archives"),
    ):
        study_runs.read_runs([str(path)], stack)


def test_a_file_that_is_not_an_archive_is_refused(run):
    (run.parent / "runs.tar.xz").write_bytes(b"text")
    with ExitStack() as stack, pytest.raises(SettingsError, match="readable archives"):
        study_runs.read_runs([str(run.parent / "runs.tar.xz")], stack)
