"""How Sphinx builds the site: ``make docs``. The network is not needed; notebooks are executed."""

from __future__ import annotations

import os
import re
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the notebooks' kernels, too
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # notebooks call `hdrqn`

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

import hdrqn_torchrl

ROOT = Path(__file__).parents[1]
PACKAGE = "hdrqn_torchrl"

project = PACKAGE
author = "The hdrqn_torchrl authors"
version = release = hdrqn_torchrl.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "_templates"]
templates_path = ["_templates"]

html_theme = "furo"
html_math_renderer = "mathml"  # which browsers draw without a script
html_title = PACKAGE
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_copyright = False
html_show_sourcelink = False

myst_enable_extensions = ["dollarmath", "attrs_inline", "colon_fence"]
myst_heading_anchors = 4
nb_execution_mode = "auto"  # a notebook that holds outputs is left as it is
nb_execution_timeout = 120
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_output_stderr = "remove"  # warnings, with paths of the machine

autosummary_generate = True
autosummary_imported_members = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # Args: have them in words, with shapes and units
autodoc_class_signature = "mixed"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
nitpick_ignore_regex = [(r"py:.*", rf"(?!{PACKAGE}).*|.*\._.*")]  # what other packages document is not looked up


def packages_above(module: str) -> list[Any]:
    """The packages that a module lies in."""
    parts = module.split(".")
    return [import_module(".".join(parts[:end])) for end in range(2, len(parts))]


def skip_exported(app: Any, what: str, name: str, thing: Any, skip: bool, options: Any) -> bool | None:
    """Documents a thing once: on the page of the package that exports it, not on that of its module too."""
    page = app.env.current_document.autodoc_module or ""
    if what != "module" or not page.startswith(PACKAGE):
        return None
    above = [package for package in packages_above(page) if name in getattr(package, "__all__", ())]
    return True if any(getattr(package, name) is thing for package in above) else None


def find_exported(app: Any, env: Any, node: Any, content: Any) -> Any:
    """Finds ``hdrqn_torchrl.runs.trainer.Trainer`` on the page of ``hdrqn_torchrl.runs``, which exports it."""
    parts, domain = node.get("reftarget", "").split("."), env.domains.python_domain
    ends = [(start, end) for start in range(2, len(parts)) for end in range(start + 1, len(parts))]
    shorter = [".".join(parts[:start] + parts[end:]) for start, end in ends]
    for target in shorter if parts[0] == PACKAGE and node.get("refdomain") == "py" else ():
        if target in domain.objects:
            return domain.resolve_xref(env, node["refdoc"], app.builder, node["reftype"], target, node, content)
    return None


UPWARDS = re.compile(r"(?<!!)\[[^\]]+\]\(((?:\.\./)+)([^)#]+)\)")
"""Links, not pictures, to what lies in a folder above."""


def prepare(app: Any, page: str, source: list[str]) -> None:
    """The same files are read on a forge, too, where links lead to other files and the changelog has its own place."""
    if page == "changelog":
        source[0] = (ROOT / "CHANGELOG.md").read_text().replace("](docs/", "](")
        source[0] = re.sub(r"\[([^\]]+)\]\((examples|benchmarks)/[^)]*\)", r"`\1`", source[0])
    source[0] = UPWARDS.sub(lambda link: shown(link, page.count("/")), source[0])


def shown(link: re.Match[str], depth: int) -> str:
    """The link as it is, or the name of the file, if it leads out of the site from a page so many folders deep."""
    return f"`{link[2]}`" if link[1].count("../") > depth else link[0]


def write_math(translator: Any, node: Any) -> None:
    """Writes a formula as MathML, a displayed one on a line of its own."""
    displayed = isinstance(node, nodes.math_block)
    formula = tex2mathml(node.astext(), as_block=displayed)
    translator.body.append(f'<div class="math">{formula}</div>' if displayed else formula)
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.add_html_math_renderer("mathml", (write_math, None), (write_math, None))
    app.connect("autodoc-skip-member", skip_exported)
    app.connect("missing-reference", find_exported)
    app.connect("source-read", prepare)
