"""The order of the package's parts: each imports only from earlier ones."""

import ast
from functools import cache
from pathlib import Path

import hdrqn_torchrl
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.settings import commands

ORDER = (
    "keys", "devices", "random_numbers", "transforms", "envs", "modules", "objectives", "data", "learning", "discovery",
    "algorithms", "runs", "export", "rendering", "analysis", "cli",
)  # fmt: skip
ROOT = Path(hdrqn_torchrl.__file__).parent
FILES = sorted(path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py")


@cache
def tree_of(path):
    return ast.parse(path.read_text())


@cache
def imports_of(path):
    """Full names of all modules that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def part_of(path):
    return path.relative_to(ROOT).with_suffix("").parts[0]


def broken(rule, paths=FILES):
    """What breaks a rule, by file; the rule takes a path and returns it."""
    found = {str(path.relative_to(ROOT)): rule(path) for path in paths}
    return {name: wrong for name, wrong in found.items() if wrong}


def test_files_import_only_from_their_own_part_and_earlier_ones():
    def later(path):
        rank = ORDER.index(part_of(path))
        used = {name.split(".")[1] for name in imports_of(path) if name.startswith("hdrqn_torchrl.")} - {"__version__"}
        return {part for part in used if ORDER.index(part) > rank}

    assert broken(later) == {}


def test_only_the_programs_import_hydra():
    def hydra(path):
        return {name.split(".")[0] for name in imports_of(path)} & {"hydra", "omegaconf"}

    assert broken(hydra, [ROOT / "__init__.py", *(path for path in FILES if path.parent.name != "cli")]) == {}
    assert broken(hydra), "the programs do"


def test_every_part_of_the_package_has_a_place_in_the_order():
    assert {part_of(path) for path in FILES} == set(ORDER)


def texts_of(path):
    """All strings in a file's code without docstrings, and the last parts of paths."""
    tree = tree_of(path)
    docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    return {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs
    }


def test_only_one_module_spells_the_file_names_of_a_run_folder():
    names = {*layout.WRITTEN, layout.CHECKPOINTS, layout.EVALUATIONS}
    others = [path for path in FILES if path.name != "configuration.py"]  # conf/ has a config.yaml, too
    assert set(broken(lambda path: texts_of(path) & names, others)) == {"runs/persistence/layout.py"}


PROGRAMS = {f"hdrqn_torchrl.cli.{name}" for name in commands.PROGRAMS}


def test_nothing_imports_from_a_program():
    def programs(path):
        return {name if name in PROGRAMS else name.rpartition(".")[0] for name in imports_of(path)} & PROGRAMS

    assert broken(programs) == {}


def test_no_two_test_files_share_a_name():
    """Without packages, pytest imports each test file by its name alone."""
    names = [path.name for path in Path(__file__).parent.rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))
