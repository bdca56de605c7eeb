"""This process in a Ray cluster: one that runs, or one of this machine that begins and ends with it."""

from __future__ import annotations

import contextlib
import shutil
import socket
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hdrqn_torchrl.runs.collectors.workers.handles import PlaceLost
from hdrqn_torchrl.runs.settings.variables import search_path, variables

_LOOPBACK, _OWN_NODE = "127.0.0.1", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
_ENVIRONMENT = {
    "RAY_gcs_rpc_server_reconnect_timeout_s": "600",  # after which Ray ends this process: an evaluation may take longer
}
_OWN_CLUSTER = {
    _OWN_NODE: "0",  # else Ray takes another address of this machine instead of the loopback one
    "RAY_AUTH_MODE": "disabled",  # else it writes a token to the home folder
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_worker_niceness": "0",  # else 15: a first process that learns would starve them
    "RAY_kill_child_processes_on_worker_exit": "0",  # they end by themselves, the one that cleans up last
}
_PATIENCE_SECONDS = 10.0
_CHECK_SECONDS = 0.5  # between two looks


class RayCluster:
    """Joins a cluster, unless this process is in one.

    Args:
        cores: of a cluster that is started here.
        address: of a running cluster, or ``"auto"`` for the one of this machine; ``None``: one is started on 127.0.0.1,
            without dashboard.
        show_output: of tasks and actors, on this terminal.
        setting: full name of ``address``, for errors.

    Raises:
        ImportError: if Ray is missing.
        ConnectionError: if there is no cluster at the address, or none can be started here that listens on 127.0.0.1
            only.
    """

    def __init__(
        self, *, cores: int, address: str | None = None, show_output: bool = False, setting: str = "address"
    ) -> None:
        ray = load_ray()
        self._began = not ray.is_initialized()
        self._logs: Path | None = None  # of a cluster that was started here
        self._has_gone = False
        common = {"configure_logging": False, "log_to_driver": show_output}
        if self._began:
            with _in_words(setting, address):
                if address is None:
                    _start_on_loopback(ray, cores, common)
                else:
                    _join(ray, address, common)
        if self._began and address is None:
            _refuse_other_addresses(ray)
            self._logs = Path(ray._private.worker._global_node.get_session_dir_path())
        self.address = ray.get_runtime_context().gcs_address
        self._services = [self.address, _own_node(ray)]
        self._seen = time.monotonic()

    def check(self) -> None:
        """Sees whether the cluster is still there; Ray itself would wait for ever, or end this process.

        Raises:
            PlaceLost: if it does not answer for ten seconds.
        """
        if time.monotonic() - self._seen < _CHECK_SECONDS:
            return
        until = time.monotonic() + _PATIENCE_SECONDS
        while silent := [service for service in self._services if not _listens(service)]:
            if time.monotonic() >= until:
                self._has_gone = True
                logs = "" if self._logs is None else f" (its logs: {self._logs})"
                raise PlaceLost(
                    f"the Ray cluster at {self.address} must answer until the end, got nothing from "
                    f"{', '.join(silent)} for {_PATIENCE_SECONDS:g} seconds{logs}; start it again"
                )
            time.sleep(1.0)
        self._seen = time.monotonic()

    def close(self) -> None:
        """Ends the cluster, or the connection to it, if it began here. Logs stay only of a cluster that was lost."""
        if self._began and load_ray().is_initialized():
            load_ray().shutdown()
            if self._logs is not None and not self._has_gone:
                _remove(self._logs)


def load_ray() -> Any:
    """The module, imported when it is first needed.

    Raises:
        ImportError: if it is missing.
    """
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise ImportError(
            "collector=ray and sweep=ray need Ray; install it: pip install 'hdrqn_torchrl[ray]'."
        ) from error
    return ray


def _start_on_loopback(ray: Any, cores: int, common: Mapping[str, bool]) -> None:
    """A cluster of this machine that nobody else can reach.

    ``ray.init`` would replace 127.0.0.1 by another address of this machine, unless a variable of the environment was
    set when Ray was imported; TorchRL imports it before anyone can set it.
    """
    from ray._private import ray_constants

    before, ray_constants.ENABLE_RAY_CLUSTER = ray_constants.ENABLE_RAY_CLUSTER, False
    try:
        with variables(_ENVIRONMENT | _OWN_CLUSTER | search_path()):
            ray.init(_node_ip_address=_LOOPBACK, num_cpus=cores, include_dashboard=False, **common)
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before


@contextlib.contextmanager
def _in_words(setting: str, address: str | None) -> Iterator[None]:
    """Tells the user what to do about whatever Ray raises when it can't begin."""
    try:
        yield
    except Exception as error:  # Ray's own are of all kinds
        reason = str(error).strip().partition("\n")[0] or type(error).__name__
        if address is None:
            raise ConnectionError(
                f"{setting} must be that of a running Ray cluster where none starts on this machine, got null "
                f"({reason}); try again when it is less busy, or start one first, `ray start --head "
                f"--node-ip-address={_LOOPBACK}`, and give {setting}=auto."
            ) from error
        raise ConnectionError(
            f"{setting} must be that of a running Ray cluster, got {address!r} ({reason}); start it with `ray start` "
            "(docs/many_machines.md), or leave the setting out to use this machine alone."
        ) from error


def _join(ray: Any, address: str, common: Mapping[str, bool]) -> None:
    """A cluster that runs. Where nothing answers, Ray itself would go on trying for minutes."""
    if address != "auto" and not address.rpartition(":")[2].isdigit():
        raise ConnectionError("it is neither auto nor HOST:PORT")
    if address != "auto" and not _listens(address):
        raise ConnectionError("nothing answers there")
    with variables(_ENVIRONMENT):
        ray.init(address=address, **common)


def _refuse_other_addresses(ray: Any) -> None:
    if (found := {node["NodeManagerAddress"] for node in ray.nodes()}) != {_LOOPBACK}:
        ray.shutdown()
        raise ConnectionError(
            f"Ray must listen on {_LOOPBACK} only, got {sorted(found)} with Ray {ray.__version__}; set {_OWN_NODE}=0 "
            "before Python starts, or start a cluster and give its address."
        )


def _remove(logs: Path) -> None:
    """Ray leaves a folder behind for each cluster, and a link to the last one."""
    shutil.rmtree(logs, ignore_errors=True)
    latest = logs.with_name("session_latest")
    if latest.is_symlink() and not latest.exists():
        latest.unlink(missing_ok=True)


def _own_node(ray: Any) -> str:
    """Where the Ray process of this machine listens."""
    here = ray.get_runtime_context().get_node_id()
    node = next(each for each in ray.nodes() if each["NodeID"] == here)
    return f"{node['NodeManagerAddress']}:{node['NodeManagerPort']}"


def _listens(service: str) -> bool:
    host, _, port = service.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=2.0).close()
    except OSError:
        return False
    return True
