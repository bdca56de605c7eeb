"""The order of the package's parts: each imports only from earlier ones."""

import ast
from pathlib import Path

import pytest

import hdrqn_torchrl
from hdrqn_torchrl.runs import commands, layout

ORDER = (
    "keys", "devices", "transforms", "envs", "modules", "objectives", "data", "learning", "discovery", "algorithms",
    "runs", "analysis", "rendering", "cli",
)  # fmt: skip
ROOT = Path(hdrqn_torchrl.__file__).parent
FILES = sorted(path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py")


def imports_of(path):
    """Full names of all modules that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def part_of(path):
    return path.relative_to(ROOT).with_suffix("").parts[0]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_file_imports_only_from_its_own_part_and_earlier_ones(path):
    rank = ORDER.index(part_of(path))
    used = {name.split(".")[1] for name in imports_of(path) if name.startswith("hdrqn_torchrl.")} - {"__version__"}
    assert {part for part in used if ORDER.index(part) > rank} == set()


@pytest.mark.parametrize("path", [ROOT / "__init__.py", *FILES], ids=lambda path: str(path.relative_to(ROOT)))
def test_only_the_programs_import_hydra(path):
    if path.parent.name == "cli":
        return
    assert not {name.split(".")[0] for name in imports_of(path)} & {"hydra", "omegaconf"}


def test_every_part_of_the_package_has_a_place_in_the_order():
    assert {part_of(path) for path in FILES} == set(ORDER)


def texts_of(path):
    """All strings in a file's code without docstrings, and the last parts of paths."""
    tree = ast.parse(path.read_text())
    docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    return {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs
    }


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_only_one_module_spells_the_file_names_of_a_run_folder(path):
    names = {*layout.WRITTEN, layout.CHECKPOINTS, layout.EVALUATIONS}
    if path == Path(layout.__file__) or path.name == "configuration.py":  # conf/ has a config.yaml, too
        return
    assert not texts_of(path) & names


PROGRAMS = {f"hdrqn_torchrl.cli.{name}" for name in commands.PROGRAMS}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_imports_from_a_program(path):
    imported = {name if name in PROGRAMS else name.rpartition(".")[0] for name in imports_of(path)}
    assert not imported & PROGRAMS


def test_no_two_test_files_share_a_name():
    """Without packages, pytest imports each test file by its name alone."""
    names = [path.name for path in Path(__file__).parent.rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))
