"""One thread and one seed for every test."""

import os
import sys

import pytest
import torch
from matplotlib.figure import Figure

torch.set_num_threads(1)
LONGEST = (
    "test_launchers", "test_resume", "test_sweeps", "test_train", "test_ray", "test_ray_cluster", "test_algorithms",
    "test_learning", "test_report", "test_captured", "test_captured_collector", "test_hostile_runs",
    "test_gym_environment", "test_random_settings", "test_faults", "test_processes",
)  # fmt: skip
"""Files of tests that take ten seconds or more."""


def pytest_collection_modifyitems(items):
    """The longest files come first, so that processes which share the files (``make test``) end together."""
    items.sort(key=lambda item: LONGEST.index(item.path.stem) if item.path.stem in LONGEST else len(LONGEST))


@pytest.fixture(scope="session", autouse=True)
def memory_for_disk():
    """Skips fsync, which takes most of the time of a small checkpoint and protects from losses of power only."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    """Results of scripted players are kept for one run of the tests, apart from the user's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.fixture(autouse=True)
def fixed_seed():
    torch.manual_seed(0)


@pytest.fixture
def figures(monkeypatch):
    """Figures as they are when they are saved."""
    kept, save = [], Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, *args, **kwargs: (kept.append(figure), save(figure, *args, **kwargs))
    )
    return kept


@pytest.fixture
def as_on_gpu(monkeypatch):
    """Makes all code take the path for GPUs, which never reads a tensor to save work."""
    users = [module for name, module in sys.modules.items() if name.startswith("hdrqn") and hasattr(module, "on_host")]
    assert len(users) > 5
    for module in users:
        monkeypatch.setattr(module, "on_host", lambda tensor: False)
