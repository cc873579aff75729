"""Starts Ray on this machine, or connects to a Ray cluster; failures become one-line errors."""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import re
import socket
import sys
from collections.abc import Generator
from pathlib import Path
from typing import Any

import lumisplat as ls

LOCAL = "local"
"""Value of ``--address`` that starts Ray on this machine for the time of one job."""
_LOOPBACK = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""Environment variable of Ray. With the value 0, Ray uses 127.0.0.1 as the address of its node, as on Windows and
macOS, and opens its ports only there. Otherwise Ray opens its ports on all interfaces, whatever ``_node_ip_address`` is
(measured with ``ss``, Ray 2.60)."""
_CURRENT = Path(os.environ.get("RAY_TMPDIR", "/tmp"), "ray", "ray_current_cluster")
"""File in which Ray stores the address of the cluster that was last started on this machine."""
_CONNECT_S = 10.0
"""Timeout of the connection that tests whether a cluster's address answers, seconds."""
_IP = re.compile(r"^\s*ip: (\S+)", re.MULTILINE)
"""Pattern of the line with a node's IP address in Ray's error message about a lost actor."""
_VERSIONS = re.compile(r"Ray: (\S+)\s+Python: (\S+)")
"""Pattern of the Ray and Python versions in Ray's message about a mismatch, once for the cluster, once for this
process."""
_ERROR_CHARS = 300
"""Largest number of characters of Ray's own error text that an error message quotes."""

_log = logging.getLogger("lumisplat")


@contextlib.contextmanager
def connected(address: str, cpus: int) -> Generator[Any]:
    """Context that connects to a Ray cluster, or starts Ray on this machine, and yields the module ``ray``.

    If the process is already connected, that connection is used.

    Args:
        address: ``local`` starts Ray here for the time of the job; ``auto`` uses the cluster that runs here;
            ``ray://host:port`` or ``host:port`` uses that cluster.
        cpus: Number of CPUs if Ray is started here.

    Raises:
        ConfigError: There is no cluster, or it has another version.
        MissingExtraError: Ray is not installed.
    """
    if address == LOCAL:
        os.environ.setdefault(_LOOPBACK, "0")
    elif _has_token():  # otherwise Ray 2.60 sends no token to a given address
        os.environ.setdefault("RAY_AUTH_MODE", "token")
    ray = _load_ray()
    if ray.is_initialized():
        yield ray
        return
    _check_reachable(address)
    options: dict[str, Any] = {"include_dashboard": False, "num_cpus": cpus} if address == LOCAL else {}
    try:
        # Ray adds the working folder to the workers' import path. Downloaded captures there could hide Python modules.
        with contextlib.chdir(sys.prefix):
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **options)
    except Exception as error:  # Ray raises errors of many types
        raise ls.ConfigError(f"--address {address}: {_connection_problem(error)}") from None
    try:
        resources = ray.cluster_resources()
        line = f"Ray {ray.__version__} at {address}: {resources.get('CPU', 0):g} CPUs, {resources.get('GPU', 0):g} GPUs"
        if address == LOCAL:
            is_private = ray.util.get_node_ip_address() == "127.0.0.1"
            line += f"; its ports are open on {'127.0.0.1 only' if is_private else 'all interfaces'}"
        _log.warning("%s", line)
        yield ray
    finally:
        ray.shutdown()


def usable_cores() -> int:
    """Returns the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _load_ray() -> Any:
    """Imports Ray with its usage reports switched off.

    Raises:
        MissingExtraError: Ray is not installed.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("PYTHONSAFEPATH", "1")
    try:
        return importlib.import_module("ray")
    except ImportError:
        divided = "without it, divide frames of orbit, animate or render --resume by --frames"
        what = f"lumisplat farm, which runs on Ray ({divided}),"
        raise ls.errors.MissingExtraError(what, "farm") from None


def _has_token() -> bool:
    """True if an environment variable or Ray's default file holds the authentication token of a Ray cluster."""
    named = os.environ.get("RAY_AUTH_TOKEN_PATH")
    path = Path(named) if named else Path.home() / ".ray" / "auth_token"
    return "RAY_AUTH_TOKEN" in os.environ or path.is_file()


def _check_reachable(address: str) -> None:
    """Raises a ConfigError if nothing listens at the value of ``--address``; Ray itself would retry for minutes.

    If a cluster listens only on 127.0.0.1, sets an environment variable that makes Ray connect to that address instead
    of this machine's network address.
    """
    named = address
    if address == "auto":  # Ray may remember the address of a cluster that has ended
        named = os.environ.get("RAY_ADDRESS", "")
        with contextlib.suppress(OSError):
            named = named or _CURRENT.read_text().strip()
    host, _, port = named.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), _CONNECT_S).close()
    except (OSError, OverflowError) as error:
        place = "there" if named == address else f"at {named}"
        raise ls.ConfigError(f"--address {address}: nothing listens {place}: {error}") from None
    if host in ("127.0.0.1", "localhost") and not _listens(_own_address(), int(port)):
        os.environ.setdefault(_LOOPBACK, "0")


def _own_address() -> str:
    """Returns this machine's IP address in its network, without sending a packet; 127.0.0.1 without a network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("8.8.8.8", 53))
        except OSError:  # the machine has no network
            return "127.0.0.1"
        return probe.getsockname()[0]


def _listens(host: str, port: int) -> bool:
    """True if a connection to a host and port succeeds."""
    try:
        socket.create_connection((host, port), _CONNECT_S).close()
    except OSError:
        return False
    return True


def _connection_problem(error: BaseException) -> str:
    """Returns why a Ray cluster cannot be used, as one line, from the exception that Ray raised."""
    if "Version mismatch" in str(error) and len(sides := _VERSIONS.findall(str(error))) == 2:
        there, here = (f"Ray {ray} with Python {python}" for ray, python in sides)
        return f"the cluster runs {there}, but this process runs {here}: install the same versions on both"
    return f"no Ray cluster can be used at this address: {_short(error)}"


def actor_failure(error: BaseException) -> str:
    """Returns why a Ray actor (worker process) was lost, as a short text, from the exception that Ray raised."""
    text, cause = str(error), getattr(error, "cause", None)
    where = f" on {found[1]}" if (found := _IP.search(text)) else ""
    if isinstance(cause, BaseException):  # an uncaught error of the worker's code
        return f"{type(cause).__name__}: {' '.join(str(cause).split())}"
    if "creation task" in text:  # the last line of the traceback names the error
        return f"it could not start{where}: {text.strip().splitlines()[-1].strip()}"
    if "node has died" in text or "node was terminated" in text:
        return f"its node{where} has died"
    if "OutOfMemory" in type(error).__name__ or "running low on memory" in text:
        return f"killed by Ray{where} because memory ran out"
    return f"its process{where} has ended" if where else _short(error)


def _short(error: BaseException) -> str:
    """Returns the message of an exception of Ray on one line, cut to `_ERROR_CHARS` characters."""
    words = " ".join(str(error).split()) or type(error).__name__
    return words if len(words) <= _ERROR_CHARS else f"{words[:_ERROR_CHARS]} ..."
