"""Files for forges and containers name only what is there, and nothing of one machine."""

import json
import re

import yaml
from processes import ROOT

CI = ROOT / ".github/workflows/ci.yml"
FILES = (
    "Dockerfile",
    ".dockerignore",
    ".devcontainer/devcontainer.json",
    ".pre-commit-config.yaml",
    CI.relative_to(ROOT),
)


def test_continuous_integration_and_the_container_of_developers_call_targets_that_exist():
    targets = set(re.findall(r"^(\w[\w-]*):", (ROOT / "Makefile").read_text(), flags=re.M))
    jobs = yaml.safe_load(CI.read_text())["jobs"].values()
    called = [step["run"] for job in jobs for step in job["steps"] if "run" in step]
    called.append(json.loads((ROOT / ".devcontainer/devcontainer.json").read_text())["postCreateCommand"])
    assert {command.removeprefix("make ") for command in called} == {"test", "docs", "setup"} <= targets


def test_what_the_image_copies_is_there():
    copied = [line.split()[1:-1] for line in (ROOT / "Dockerfile").read_text().splitlines() if line.startswith("COPY")]
    names = {name for names in copied for name in names}
    assert all((ROOT / name).exists() for name in names)
    shown = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert names == shown


def test_no_file_has_a_path_of_a_machine():
    for name in FILES:
        assert not re.search(r"/(tmp|root|home)/", (ROOT / name).read_text()), name
