"""The package as users get it: a wheel in a separate environment, without the checkout."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import venv

import pytest
from processes import ROOT
from programs import TINY, TINY_HDRQN

import hdrqn_torchrl

SOURCES = ("hdrqn_torchrl", "conf", "pyproject.toml", "setup.py", "README.md", "LICENSE")
DEPENDENCIES = sysconfig.get_paths()["purelib"]
WATCH = f"""
import os, sys

def watch(event, arguments):
    path = arguments[0] if event == "open" else None
    if isinstance(path, str) and path.startswith({str(ROOT)!r}) and not path.startswith({DEPENDENCIES!r}):
        os.write(notes, f"{{path}}\\n".encode())

notes = os.open(os.path.join(sys.prefix, "read.txt"), os.O_WRONLY | os.O_APPEND | os.O_CREAT)
sys.addaudithook(watch)
"""
"""Records every file of the checkout that a process opens."""


def run(*command, folder):
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"OMP_NUM_THREADS": "1"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A virtual environment inside another git repository, with the wheel and this environment's dependencies."""
    folder = tmp_path_factory.mktemp("elsewhere")
    source, environment = folder / "source", folder / "environment"
    source.mkdir()
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, source / name)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    built = run(*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(folder), str(source), folder=folder)
    assert built.returncode == 0, built.stderr
    (wheel,) = folder.glob("*.whl")
    shutil.rmtree(source)
    venv.create(environment, symlinks=True)
    python = environment / "bin" / "python"
    put = run(*pip, "--python", str(python), "install", "--no-deps", "--no-index", str(wheel), folder=folder)
    assert put.returncode == 0, put.stderr
    (packages,) = environment.glob("lib/python*/site-packages")
    (packages / "watch_checkout.py").write_text(WATCH)
    (packages / "dependencies.pth").write_text(f"{DEPENDENCIES}\nimport watch_checkout\n")  # theirs are not read
    run("git", "init", folder=folder)
    run("git", "-c", "user.name=a", "-c", "user.email=a@b", "commit", "--allow-empty", "-m", "theirs", folder=folder)
    return environment


@pytest.fixture(scope="module")
def trained(installed):
    """A run of 2,000 frames with a custom configuration folder, and the program's output."""
    folder = installed.parent / "work"
    mine = folder / "mine" / "algo"
    mine.mkdir(parents=True)
    (mine / "patient.yaml").write_text("defaults:\n  - v2\n  - _self_\ngamma: 0.75\n")
    arguments = [*TINY, *TINY_HDRQN, "algo=patient", "logger=csv", "hydra.run.dir=run", "--config-dir", "mine"]
    done = run(str(installed / "bin" / "hdrqn"), "train", *arguments, folder=folder)
    assert done.returncode == 0, done.stderr
    return folder / "run", done


@pytest.mark.slow
def test_the_installed_command_trains(trained):
    folder, done = trained
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["frames"] >= 2000 and summary["updates"] > 0
    assert json.loads(done.stdout)["run"] == str(folder)


@pytest.mark.slow
def test_the_installed_command_uses_a_custom_configuration_folder(trained):
    assert "gamma: 0.75" in (trained[0] / "config.yaml").read_text()


@pytest.mark.slow
def test_the_commit_of_an_enclosing_repository_is_not_recorded(trained):
    assert json.loads((trained[0] / "run.json").read_text())["commit"] is None


@pytest.mark.slow
def test_the_installed_command_evaluates_without_the_checkout(trained, installed):
    done = run(str(installed / "bin" / "hdrqn"), "evaluate", "run=run", "episodes=8", folder=trained[0].parent)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["episodes"] == 8
    assert (installed / "read.txt").read_text() == ""


@pytest.mark.slow
def test_errors_of_the_installed_command_say_what_to_type(installed):
    refused = run(str(installed / "bin" / "hdrqn"), "train", "algo.gamma=high", folder=installed)
    assert refused.returncode == 1 and "`hdrqn train --cfg job` shows every setting" in refused.stderr


def test_the_installed_command_prints_version_and_programs(installed):
    hdrqn = str(installed / "bin" / "hdrqn")
    assert run(hdrqn, "--version", folder=installed).stdout == f"{hdrqn_torchrl.__version__}\n"
    assert "train|evaluate|watch|export|plot|report|check|zoo" in run(hdrqn, "--help", folder=installed).stdout


def test_the_wheel_holds_every_file_of_the_package_and_of_conf(installed):
    (packages,) = installed.glob("lib/python*/site-packages")
    for name, place in (("hdrqn_torchrl", "hdrqn_torchrl"), ("conf", "hdrqn_torchrl/conf")):
        files = [path.relative_to(ROOT / name) for path in (ROOT / name).rglob("*") if path.suffix in (".py", ".yaml")]
        assert files and not [path for path in files if not (packages / place / path).is_file()]
    assert not (packages / "conf").exists()
