"""What a user is told who has no Ray cluster, before anything is trained."""

from __future__ import annotations

import re
from importlib.util import find_spec
from types import SimpleNamespace

import pytest

from hdrqn_torchrl.runs.collectors import making as collecting
from hdrqn_torchrl.runs.collectors.workers import ray_cluster
from hdrqn_torchrl.runs.collectors.workers.ray_cluster import RayCluster
from hdrqn_torchrl.runs.settings.arguments import SettingsError

needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")
NOBODY = "127.0.0.1:1"


def place(address):
    settings = SimpleNamespace(collector=SimpleNamespace(kind="ray", workers=1, address=address))
    return collecting._place(settings, None)


@needs_ray
@pytest.mark.parametrize(
    ("address", "reason"),
    [(NOBODY, "nothing answers there"), ("ray://" + NOBODY, "nothing answers there"), ("local", "neither auto nor")],
)
def test_an_address_without_a_cluster_is_refused_at_once(address, reason):
    rule = re.escape(f"collector.address must be that of a running Ray cluster, got {address!r} (")
    with pytest.raises(SettingsError, match=rule + f".*{reason}.*; start it with `ray start`"):
        place(address)


@needs_ray
@pytest.mark.parametrize("error", [Exception, RuntimeError, TimeoutError, ValueError])
def test_a_cluster_that_does_not_start_in_time_is_told_in_words(error, monkeypatch):
    import ray

    def init(**_):
        raise error("The current node timed out during startup. This could happen because ...\nand more")

    monkeypatch.setattr(ray, "init", init)
    with pytest.raises(SettingsError, match=r"got null \(The current node timed out during .* \.\.\.\); try again"):
        place(None)


@needs_ray
def test_one_that_listens_elsewhere_is_ended(monkeypatch):
    import ray

    ended = []
    monkeypatch.setattr(ray, "init", lambda **_: None)
    monkeypatch.setattr(ray, "nodes", lambda: [{"NodeManagerAddress": "10.0.0.1"}])
    monkeypatch.setattr(ray, "shutdown", lambda: ended.append(True))
    with pytest.raises(ConnectionError, match=r"Ray must listen on 127\.0\.0\.1 only, got \['10\.0\.0\.1'\]"):
        RayCluster(cores=1)
    assert ended == [True]


def test_without_ray_the_extra_is_named(monkeypatch):
    def load():
        raise ImportError("collector=ray and sweep=ray need Ray; install it: pip install 'hdrqn_torchrl[ray]'.")

    monkeypatch.setattr(ray_cluster, "load_ray", load)
    with pytest.raises(SettingsError, match="collector=ray and sweep=ray need Ray; install it"):
        place(None)
