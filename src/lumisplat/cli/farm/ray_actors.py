"""Workers as actors of Ray, on one machine or many.

Ray starts none of them again and repeats no frame by itself: the driver does, as with processes, so that one rule says
how often a frame is tried. A node that dies is actors that are lost; their successors start wherever there is room,
also on nodes that have joined since.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import os
import re
import socket
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lumisplat as ls
from lumisplat.cli.farm.executor import Event, Failed, Lost, Refused, Said
from lumisplat.cli.farm.places import CORES, THREADS_VARIABLE, FarmRoom
from lumisplat.cli.farm.worker import Order, Worker

_LOOPBACK = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""At 0, Ray takes 127.0.0.1 for its node, as it does on Windows and macOS, and its ports are open there alone. Else
they are open on all interfaces, whatever ``_node_ip_address`` says (measured with ``ss``, Ray 2.60)."""


_CURRENT = Path(os.environ.get("RAY_TMPDIR", "/tmp"), "ray", "ray_current_cluster")
"""Where Ray keeps the address of the cluster that was started last on this machine."""
_CONNECT_S = 10.0
"""How long an address may take to answer, seconds."""
_IP = re.compile(r"^\s*ip: (\S+)", re.MULTILINE)
"""In what Ray says of an actor."""
_VERSIONS = re.compile(r"Ray: (\S+)\s+Python: (\S+)")
"""In what Ray says of two sides that differ."""
_SAID = 300
"""Characters of what Ray says that are passed on."""


@dataclass(frozen=True)
class Answer:
    """Of an actor."""

    lines: list[str]
    """Its remarks."""
    event: Event
    host: str
    """The name of its machine."""

    def events(self) -> list[Event]:
        """What the driver is told; an error says on which machine it was, if that is another one."""
        if isinstance(self.event, Failed | Refused) and self.host != socket.gethostname():
            self.event.error.add_note(f"on {self.host}")
        return [*(Said(self.event.worker, line) for line in self.lines), self.event]


class RayWorker:
    """What runs as an actor: a `Worker` whose answers carry its remarks."""

    def __init__(self, number: int, order: Order, environment: dict[str, str]) -> None:
        self._worker = Worker(number, order, environment)

    def open(self) -> Answer:
        """Loads the scene."""
        return self._answer(self._worker.open(_nothing))

    def make(self, frame: int) -> Answer:
        """Makes a frame."""
        return self._answer(self._worker.make(frame))

    def _answer(self, event: Event) -> Answer:
        lines, self._worker.lines[:] = list(self._worker.lines), []
        return Answer(lines, event, socket.gethostname())


@dataclass
class _Actor:
    """An actor, and what it was asked for and has not answered."""

    handle: Any
    asked: list[Any] = field(default_factory=list[Any])


class RayActors:
    """An `Executor` of actors.

    Args:
        order: What they are to do.
        environment: Variables of their processes.
        options: What each of them needs: ``num_cpus`` or ``num_gpus``.
    """

    def __init__(self, order: Order, environment: dict[str, str], options: dict[str, float]) -> None:
        self._ray = load_ray()
        self._order, self._environment = order, environment
        self._remote = self._ray.remote(max_restarts=0, max_task_retries=0, **options)(RayWorker)
        self._actors: dict[int, _Actor] = {}
        self._count = 0

    def start(self) -> int:
        """As `Executor.start`."""
        number, self._count = self._count, self._count + 1
        handle = self._remote.remote(number, self._order, self._environment)
        self._actors[number] = _Actor(handle, [handle.open.remote()])
        return number

    def submit(self, worker: int, frame: int) -> None:
        """As `Executor.submit`."""
        if worker in self._actors:
            actor = self._actors[worker]
            actor.asked.append(actor.handle.make.remote(frame))

    def stop(self, worker: int) -> None:
        """As `Executor.stop`."""
        if worker in self._actors:
            self._ray.kill(self._actors.pop(worker).handle)

    def events(self, timeout: float) -> Sequence[Event]:
        """As `Executor.events`."""
        owners = {ref: number for number, actor in self._actors.items() for ref in actor.asked}
        if not owners:
            time.sleep(timeout)
            return []
        self._ray.wait(list(owners), num_returns=1, timeout=timeout)
        answered, _ = self._ray.wait(list(owners), num_returns=len(owners), timeout=0.0)  # all that have by now
        return [event for ref in answered if owners[ref] in self._actors for event in self._heard(owners[ref], ref)]

    def close(self) -> None:
        """As `Executor.close`."""
        for number in list(self._actors):
            self.stop(number)
        self._ray.shutdown()

    def _heard(self, number: int, ref: Any) -> list[Event]:
        """The answer of an actor, or that it is gone."""
        self._actors[number].asked.remove(ref)
        try:
            answer: Answer = self._ray.get(ref)
        except self._ray.exceptions.RayError as error:
            self.stop(number)
            return [Lost(number, end_of_actor(error))]
        return answer.events()


def connect(address: str) -> str:
    """Connects to a cluster of Ray, or starts one here.

    Args:
        address: ``ray``: one is started here, for as long as the job takes; ``auto``: that which runs here;
            ``ray://host:port`` or ``host:port``: that one.

    Returns:
        What listens where, in a line.

    Raises:
        ConfigError: There is none, or it is of another version.
        MissingExtraError: Ray is not installed.
    """
    if address == "ray":
        os.environ.setdefault(_LOOPBACK, "0")
    elif _has_token():
        os.environ.setdefault(
            "RAY_AUTH_MODE", "token"
        )  # else it is not shown where an address is given, as of Ray 2.60
    if importlib.util.find_spec("ray") is None:
        raise _missing()
    _check_reachable(address)
    ray = load_ray()
    options: dict[str, Any] = {"address": address}
    if address == "ray":  # a new one, where "auto" would also take one that is there
        options = {"address": "local", "include_dashboard": False}
    try:
        ray.init(log_to_driver=False, logging_level=logging.ERROR, **options)
    except Exception as error:  # Ray raises whatever its parts do
        raise ls.ConfigError(f"--address {address}: {_why_not(error)}") from None
    resources = ray.cluster_resources()
    room = f"{resources.get('CPU', 0):g} CPUs, {resources.get('GPU', 0):g} GPUs"
    if address != "ray":
        return f"Ray {ray.__version__} at {address}: {room}"
    heard = "on 127.0.0.1 alone" if ray.util.get_node_ip_address() == "127.0.0.1" else "on all interfaces"
    return f"Ray {ray.__version__} was started here for this job ({room}); its ports are open {heard}"


def ray_room(room: FarmRoom) -> tuple[int, dict[str, float], dict[str, str]]:
    """How many actors there are, what each needs, and the variables of its process.

    An actor has a GPU to itself where the cluster has any, else its cores.
    """
    resources = load_ray().cluster_resources()
    gpus = int(resources.get("GPU", 0)) if room.takes_gpus else 0
    cpus = int(resources.get("CPU", 1))
    count = room.workers or gpus or max(1, cpus // (room.cores or CORES))
    cores = room.cores or max(1, min(CORES, cpus // count))
    needs: dict[str, float] = {"num_gpus": 1, "num_cpus": 1} if gpus else {"num_cpus": cores}
    return count, needs, {THREADS_VARIABLE: f"{cores}"}


def load_ray() -> Any:
    """Ray, without its reports of usage.

    Raises:
        MissingExtraError: It is not installed.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        return importlib.import_module("ray")
    except ImportError:
        raise _missing() from None


def _missing() -> ls.MissingExtraError:
    return ls.MissingExtraError("--address with Ray", "farm")


def _has_token() -> bool:
    """Whether there is a token to show to a cluster, where Ray looks for it."""
    named = os.environ.get("RAY_AUTH_TOKEN_PATH")
    path = Path(named) if named else Path.home() / ".ray" / "auth_token"
    return "RAY_AUTH_TOKEN" in os.environ or path.is_file()


def _check_reachable(address: str) -> None:
    """Raises ConfigError if nothing listens at an address: Ray itself would try for minutes.

    A cluster that listens on 127.0.0.1 alone is sought there, where Ray would try another address of this machine.
    """
    named = address
    if address == "auto":  # Ray remembers clusters that have died
        named = os.environ.get("RAY_ADDRESS", "")
        with suppress(OSError):
            named = named or _CURRENT.read_text().strip()
    host, _, port = named.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), _CONNECT_S).close()
    except (OSError, OverflowError) as error:
        place = "there" if named == address else f"at {named}"
        raise ls.ConfigError(f"--address {address}: nobody listens {place}: {error}") from None
    if host in ("127.0.0.1", "localhost") and not _listens(_own_address(), int(port)):
        os.environ.setdefault(_LOOPBACK, "0")


def _own_address() -> str:
    """The address of this machine by which others reach it; no packet is sent to find it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("8.8.8.8", 53))
        except OSError:  # it has no network
            return "127.0.0.1"
        return probe.getsockname()[0]


def _listens(host: str, port: int) -> bool:
    """Whether somebody listens."""
    try:
        socket.create_connection((host, port), _CONNECT_S).close()
    except OSError:
        return False
    return True


def _why_not(error: BaseException) -> str:
    """Why a cluster cannot be used, of an error of Ray's."""
    if "Version mismatch" in str(error) and len(sides := _VERSIONS.findall(str(error))) == 2:
        there, here = (f"Ray {ray} with Python {python}" for ray, python in sides)
        return f"the cluster is of {there}, this process of {here}: install the same on both sides"
    return f"no cluster of Ray can be used there: {_short(error)}"


def end_of_actor(error: BaseException) -> str:
    """How an actor has ended, of an error of Ray's, in a few words."""
    text, cause = str(error), getattr(error, "cause", None)
    where = f" on {found[1]}" if (found := _IP.search(text)) else ""
    if isinstance(cause, BaseException):  # an error of ours that was not caught
        return f"{type(cause).__name__}: {' '.join(str(cause).split())}"
    if "creation task" in text:  # the last line of a traceback is the error's
        return f"it could not start{where}: {text.strip().splitlines()[-1].strip()}"
    if "node has died" in text or "node was terminated" in text:
        return f"its node{where} has died"
    if "OutOfMemory" in type(error).__name__ or "OOM" in text:
        return f"killed by Ray{where} for want of memory"
    return f"its process{where} has ended" if where else _short(error)


def _short(error: BaseException) -> str:
    """The beginning of what Ray says, which goes on for pages."""
    words = " ".join(str(error).split()) or type(error).__name__
    return words if len(words) <= _SAID else f"{words[:_SAID]} ..."


def _nothing(label: str, fraction: float) -> None:
    """Shows no progress: an actor answers once."""
