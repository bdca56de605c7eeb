"""Workers in this process, to be lost at will."""

from __future__ import annotations

import torch

from hdrqn_torchrl.runs.collectors.workers import PlaceLost, Worker, WorkerLost


class HereWorkers:
    """A place whose workers answer when they are asked, with random numbers of their own."""

    def __init__(self, make):
        self.make, self.started, self.closed = make, [], 0
        self.loses = []  # numbers of those that are lost at their next answer
        self.refuses = []  # numbers of those that are lost when they are next sent something
        self.calls = []  # what was sent and received, and whose it is
        self.has_gone = False

    def start(self, index, *, seed):
        self.started.append((index, seed))
        return HereWorker(self, index, seed)

    def share(self, weights):
        return weights

    def close(self):
        self.closed += 1


class HereWorker:
    def __init__(self, place, index, seed):
        self.place, self.index, self.stopped = place, index, False
        with torch.random.fork_rng():
            self.worker = Worker(place.make, index, seed=seed, steps=8)
            self.stream = torch.get_rng_state()

    def send(self, method, *args):
        if self.index in self.place.refuses:
            self.place.refuses.remove(self.index)
            raise WorkerLost("was lost")
        self.place.calls.append(("send", self.index))
        self.call = method, args

    def receive(self, seconds):
        if self.place.has_gone:
            raise PlaceLost("the place must answer, got nothing")
        if self.index in self.place.loses:
            self.place.loses.remove(self.index)
            raise WorkerLost("was lost")
        self.place.calls.append(("receive", self.index))
        method, args = self.call
        if method == "collect" and len(args) > 1 and args[1] is not None:
            return self.worker.collect(*args)
        with torch.random.fork_rng():
            torch.set_rng_state(self.stream)
            answer = getattr(self.worker, method)(*args)
            self.stream = torch.get_rng_state()
        return answer

    def stop(self):
        self.stopped = True
