"""Collection by many workers, in processes of this machine or in a Ray cluster, as exact as by one collector."""

from hdrqn_torchrl.runs.collectors.workers.collector import WorkersCollector
from hdrqn_torchrl.runs.collectors.workers.handles import PlaceLost, WorkerError, WorkerLost
from hdrqn_torchrl.runs.collectors.workers.processes import ProcessWorkers
from hdrqn_torchrl.runs.collectors.workers.worker import MakeWorker, Worker

__all__ = ["MakeWorker", "PlaceLost", "ProcessWorkers", "Worker", "WorkerError", "WorkerLost", "WorkersCollector"]
