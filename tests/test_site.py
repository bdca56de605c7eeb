"""The pages of docs/: each is in the site's table of contents, and what it links to is there."""

import re
import subprocess
import sys
from contextlib import suppress
from functools import cache, reduce
from importlib import import_module

import pytest
from processes import ROOT

DOCS = ROOT / "docs"
PAGES = {page.relative_to(DOCS).with_suffix("").as_posix(): page for page in sorted(DOCS.rglob("*.md"))}
PAGES = {name: page for name, page in PAGES.items() if not name.startswith("_build/")}
SOURCES = sorted((ROOT / "hdrqn_torchrl").rglob("*.py"))


def contents(page):
    """Pages that a page's tables of contents name."""
    tables = re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(), flags=re.S)
    return {line for table in tables for line in table.splitlines() if line and not line.startswith(":")}


def test_every_page_is_in_the_table_of_contents():
    named = contents(DOCS / "index.md")
    assert named == set(PAGES) - {"index"}


@pytest.mark.parametrize("name", PAGES)
def test_files_that_a_page_links_to_are_there(name):
    text = re.sub(r"```.*?```", "", PAGES[name].read_text(), flags=re.S)
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text)
    missing = [link for link in links if "://" not in link and not (PAGES[name].parent / link).exists()]
    assert missing == []


@pytest.mark.parametrize("name", [name for name in PAGES if name != "changelog"])
def test_files_of_this_project_that_a_page_names_are_there(name):
    paths = re.findall(r"`((?:tests|hdrqn_torchrl|conf|benchmarks|examples)/[\w/.-]+\.\w+)`", PAGES[name].read_text())
    assert [path for path in paths if not (ROOT / path).exists()] == []


@pytest.mark.parametrize("name", [name for name in PAGES if name.startswith("tutorials/")])
def test_notebooks_of_the_site_compile(name):
    cells = re.findall(r"```\{code-cell\} ipython3\n(.*?)```", PAGES[name].read_text(), flags=re.S)
    assert cells
    for code in cells:
        if not code.startswith("%%bash"):
            compile(re.sub(r"^:.*\n", "", code), name, "exec")


@cache
def found(target):
    """Whether a full name is a module, or something in one."""
    parts = target.split(".")
    for end in range(len(parts), 0, -1):
        with suppress(ImportError, AttributeError):
            module = import_module(".".join(parts[:end]))
            owner = reduce(getattr, parts[end:-1], module)
            named = {name for each in getattr(owner, "__mro__", ()) for name in vars(each).get("__annotations__", ())}
            return end == len(parts) or hasattr(owner, parts[-1]) or parts[-1] in named
    return False


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_docstrings_and_pages_refer_to_is_there(path):
    """Sphinx finds it out, too, in minutes."""
    targets = re.findall(r":(?:class|func|meth|mod|data|attr|exc):`~?(hdrqn_torchrl[\w.]*)`", path.read_text())
    assert [target for target in targets if not found(target)] == []


@pytest.mark.slow  # minutes: all notebooks run
def test_the_site_is_built_without_a_warning(tmp_path):
    pytest.importorskip("myst_nb", reason="the extra 'docs' is not installed")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-n", "-q", "-b", "html", "-d", tmp_path / "trees"]
    done = subprocess.run([*command, DOCS, tmp_path / "site"], capture_output=True, text=True, timeout=1_800)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site/index.html").exists()
