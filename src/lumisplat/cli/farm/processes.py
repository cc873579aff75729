"""Workers as processes of this machine. They end with their driver, however that ends, and are heard by pipes alone."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from queue import SimpleQueue

from lumisplat.cli.farm.executor import Event, Lost, Reported, Said
from lumisplat.cli.farm.worker import Order, Worker

_REPORT_EVERY_S = 0.2
"""Between two reports of a worker that loads its scene, seconds."""


@dataclass(frozen=True)
class WorkerPlace:
    """Where a worker runs."""

    environment: dict[str, str]
    """Variables of its process: which GPU it sees, how many threads it has."""


@dataclass
class _Process:
    process: BaseProcess
    connection: Connection
    place: WorkerPlace


class Processes:
    """An `Executor` of processes.

    Args:
        order: What they are to do.
        places: Where they run; a process that is started in place of another runs where that did.
    """

    def __init__(self, order: Order, places: Sequence[WorkerPlace]) -> None:
        self._order, self._free = order, list(places)
        self._processes: dict[int, _Process] = {}
        self._count = 0

    def start(self) -> int:
        """As `Executor.start`."""
        number, self._count = self._count, self._count + 1
        place = self._free.pop(0)
        ours, theirs = multiprocessing.Pipe()
        arguments = theirs, number, self._order, place.environment
        # Spawned: a fork would copy the threads of this process, of which only one would go on.
        process = multiprocessing.get_context("spawn").Process(target=serve, args=arguments, daemon=True)
        os.environ.setdefault("PYTHONSAFEPATH", "1")  # else a worker runs modules of the working folder as Python's own
        process.start()
        theirs.close()  # so that its end is heard here
        self._processes[number] = _Process(process, ours, place)
        return number

    def submit(self, worker: int, frame: int) -> None:
        """As `Executor.submit`."""
        with suppress(KeyError, OSError):  # it is gone, which `Lost` says
            self._processes[worker].connection.send(frame)

    def stop(self, worker: int) -> None:
        """As `Executor.stop`."""
        if worker in self._processes:
            self._remove(worker)

    def events(self, timeout: float) -> Sequence[Event]:
        """As `Executor.events`."""
        numbers = {each.connection: number for number, each in self._processes.items()}
        found: list[Event] = []
        for connection in wait(list(numbers), timeout):
            assert isinstance(connection, Connection)
            number = numbers[connection]
            try:
                found.append(connection.recv())
            except (EOFError, OSError):
                found.append(Lost(number, self._remove(number)))
        return found

    def close(self) -> None:
        """As `Executor.close`."""
        for number in list(self._processes):
            self._remove(number)

    def _remove(self, number: int) -> str:
        """Ends a process, if it has not ended; what is known of its end."""
        removed = self._processes.pop(number)
        removed.connection.close()
        removed.process.join(1.0)  # one that has ended by itself says how
        how = _end(removed.process.exitcode)
        removed.process.kill()
        removed.process.join()
        self._free.append(removed.place)
        return how


def serve(connection: Connection, number: int, order: Order, environment: dict[str, str]) -> None:
    """The process of a worker. It ends at once when its pipe does: the driver has ended, or wants no more of it.

    Args:
        connection: To the driver: numbers of frames come in, events go out.
        number: The worker's.
        order: What it is to do.
        environment: Variables of the process.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the driver's, and ends this process by its pipe
    given: SimpleQueue[int] = SimpleQueue()
    worker = Worker(number, order, environment)
    told = time.monotonic()

    def listen() -> None:
        try:
            while True:
                given.put(connection.recv())
        except (EOFError, OSError):
            os._exit(0)

    def tell(event: Event) -> None:
        try:
            connection.send(event)
        except OSError:
            os._exit(0)

    def report(label: str, fraction: float) -> None:
        nonlocal told
        if fraction >= 1.0 or time.monotonic() - told > _REPORT_EVERY_S:
            told = time.monotonic()
            tell(Reported(number, label, fraction))

    def answer(event: Event) -> None:
        while worker.lines:
            tell(Said(number, worker.lines.pop(0)))
        tell(event)

    threading.Thread(target=listen, daemon=True).start()
    answer(worker.open(report))
    while True:
        answer(worker.make(given.get()))


def _end(status: int | None) -> str:
    """How a process has ended."""
    if status is None:
        return "it does not answer"
    if status >= 0:
        return f"it ended with status {status}"
    try:
        name = signal.Signals(-status).name
    except ValueError:
        name = f"signal {-status}"
    return f"killed by {name}" + (", perhaps for want of memory" if name == "SIGKILL" else "")
