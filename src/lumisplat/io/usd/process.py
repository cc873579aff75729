"""OpenUSD files are read by a process of their own, with limits of memory and time.

The library believes what a file claims: a crafted one takes all memory, runs for hours or ends the process. Here that
process is a child, which sends what it has read and nothing else. It names the files that a stage is composed of, and
the parent checks them before the child composes it. Where processes can fork, one that has loaded the library waits for
requests and forks for each, so that only the first one waits for the library.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib.util
import io
import logging
import os
import pickle
import signal
import struct
import subprocess
import sys
import threading
import time
import traceback
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, cast

from lumisplat.errors import FormatError, LumisplatError, MissingExtraError
from lumisplat.io.files.source import PathLike, check_regular, leaves_folder, may_leave_folder, references_outside

USD_MEMORY = 3 * 2**28
"""Memory, bytes, that the process that reads a stage may take at least: the library and Warp take 0.2 GB of it."""

USD_ASSETS_MEMORY = 2 * 2**30
"""Further bytes of memory from the first texture on, which are bounded by themselves (`TEXTURE_BYTES_FREE`)."""

USD_MEMORY_PER_BYTE = 40
"""Further bytes of memory for each byte of layers and textures: text of 8 digits becomes doubles, which are held three
times."""

USD_CPU_SECONDS = 30
"""Processor time, seconds, that reading a stage may take at least: references nested 16 deep took minutes."""

USD_CPU_SECONDS_PER_MEGABYTE = 1.0
"""Further seconds for each 2^20 bytes of the files: text is read in 0.1 s."""

USD_WALL_FACTOR = 10.0
"""Time on the clock after which reading ends, as a factor of its processor time: on machines that are busy."""

USD_START_SECONDS = 300.0
"""Time on the clock, seconds, in which that process must have loaded the library: 0.2 s on a machine that is idle."""

USD_IDLE_SECONDS = 60.0
"""Time without a request, seconds, after which the process that has loaded the library ends."""

_log = logging.getLogger("lumisplat")

_START = "import sys; sys.path[:] = sys.argv[1:]; from lumisplat.io.usd.process import serve; serve()"
"""What a child runs: its modules are those of the parent, and none of the working folder's."""

_FORKS = hasattr(os, "fork") and sys.platform != "darwin"
"""Whether processes fork; macOS' libraries do not survive it."""


@dataclass(frozen=True, slots=True)
class _Request:
    """What the child is to do."""

    module: str
    function: str
    arguments: tuple[Any, ...]
    path: Path
    folder: str
    """Working folder of the parent, from which paths begin."""
    allow_outside: bool
    limit: _Limit
    """What may be taken before the first layer is granted."""
    level: int
    """Least level of log lines that the parent shows."""


def read_in_child(path: PathLike, function: Callable[..., Any], *arguments: Any) -> Any:
    """Runs a function that reads an OpenUSD file in a child, and returns its result.

    Args:
        path: The file.
        function: A function of a module, called with ``Path(path)`` and ``arguments``.
        *arguments: Further arguments. What of the result is a `Remote` stays in the child, which then lives as long.

    Raises:
        FormatError: As of the function; or the child has ended, or taken more memory or time than files of this size
            need.
        MissingExtraError: usd-core is not installed.
    """
    if importlib.util.find_spec("pxr") is None:
        raise MissingExtraError("USD", "usd")
    request = _Request(
        function.__module__,
        function.__name__,
        arguments,
        Path(path),
        os.getcwd(),
        may_leave_folder(),
        _Limit.of(_size_of(Path(path))),
        _log.getEffectiveLevel(),
    )
    child = _Child.acquire()
    try:
        result = child.call(request, request.path)
    except LumisplatError:
        child.release()
        raise
    except BaseException:
        child.end()
        raise
    child.release()
    return result


class Remote:
    """A function of one argument that stays in the child: the parent gets one that asks it.

    Args:
        function: The function.
    """

    def __init__(self, function: Callable[[float], Any]) -> None:
        self._function = function

    def __call__(self, argument: float) -> Any:
        """Calls the function."""
        return self._function(argument)


# --- The parent ---


class _Child:
    """A process that reads files, as its parent sees it."""

    _idle: list[_Child] = []  # noqa: RUF012
    _lock = threading.RLock()  # `_drop_remote` may run at any time, also within `acquire`

    def __init__(self) -> None:
        home = os.fspath(Path(__file__).parents[3])  # where the parent has found this package
        paths = dict.fromkeys([*(path for path in sys.path if path), home])
        env = os.environ | {"MALLOC_ARENA_MAX": "2", "OPENBLAS_NUM_THREADS": "1"}
        env.pop("PXR_AR_DEFAULT_SEARCH_PATH", None)  # files are found from those that name them alone
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _START, *paths],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=env,
        )
        self._in, self._out = cast(BinaryIO, self._process.stdin), cast(BinaryIO, self._process.stdout)
        self._reader = 0
        """The process that reads the file: the child itself, or what it has forked; 0: none."""
        self._limit = _Limit.of(0)
        """Of the file that is read."""
        self._size = 0
        """Bytes of its layers so far."""
        self._calls = threading.Lock()
        self._remotes = 0
        """Functions that the parent still has."""
        self._path = Path()

    @classmethod
    def acquire(cls) -> _Child:
        """Returns a child that waits for a request."""
        with cls._lock:
            while cls._idle:
                child = cls._idle.pop()
                if child._process.poll() is None:
                    return child
                child.end()
        return cls()

    def release(self) -> None:
        """Ends the reading of a file, unless functions of it are still there: then the last of them does."""
        if self._remotes:
            return
        with contextlib.suppress(OSError, EOFError, ValueError):  # it may have ended, and its streams be closed
            if self._reader:
                self._send("done")
            if self._reader and _FORKS and self._receive()[0] == "ended":
                self._reader = 0
                with self._lock:
                    self._idle.append(self)
                return
        self.end()

    def end(self) -> None:
        """Ends the process, whatever it does."""
        with contextlib.suppress(OSError):
            if self._reader and self._reader != self._process.pid and self._process.poll() is None:
                os.kill(self._reader, signal.SIGKILL)
        self._process.kill()
        for stream in (self._in, self._out):
            with contextlib.suppress(OSError):
                stream.close()
        self._process.wait()

    def call(self, request: _Request | tuple[int, float], path: Path) -> Any:
        """Sends a request, or calls a function by its number, and returns what comes of it.

        Raises:
            FormatError: As of `read_in_child`.
        """
        self._path = path
        limit = self._begin(request)
        with self._calls:
            try:
                self._send(request)
                timer = _timer(USD_START_SECONDS, self.end)
                try:
                    while True:
                        kind, value = self._receive()
                        if kind == "log":
                            _log.log(*value)
                        elif kind in ("reader", "file", "limit"):
                            timer.cancel()
                            self._update_limit(kind, value)
                            limit = self._limit
                            timer = limit.timer(self.end)
                        elif kind == "result":
                            return value
                        elif kind == "error":
                            raise value from None
                        elif kind == "crash":
                            raise RuntimeError(value)
                        else:
                            self._reader = 0
                            raise _death_error(path, limit, -value)
                finally:
                    timer.cancel()
            except LumisplatError:
                raise
            except (EOFError, OSError, ValueError):  # a ValueError: `end` has closed the streams
                if not self._reader:
                    raise FormatError(path, "cannot be read: the process that reads OpenUSD does not start") from None
                self._process.kill()
                raise _death_error(path, limit, self._process.wait()) from None
            except KeyboardInterrupt:  # nobody waits for the answer any more
                self.end()
                raise

    def _begin(self, request: _Request | tuple[int, float]) -> _Limit:
        """Forgets the file before, if the request is another one, and returns the limit of the call."""
        if isinstance(request, _Request):
            self._reader, self._size, self._limit = 0, 0, request.limit
        return self._limit

    def _update_limit(self, kind: str, value: Any) -> None:
        """Sets the limit from now on: the process has forked, asks for a file, or has raised it for a texture."""
        if kind == "reader":
            self._reader = value
        elif kind == "limit":
            self._limit = value
        else:
            self._size += _checked_size(self._path, value)
            self._limit = _Limit.of(self._size)
            self._send(self._limit)

    def _send(self, value: Any) -> None:
        send(self._in, value)

    def _receive(self) -> tuple[str, Any]:
        return receive(self._out, self._remote)

    def _remote(self, number: int) -> Callable[[float], Any]:
        """A function of the child, which reads no other file before the last of them is gone."""
        self._remotes += 1

        def call(argument: float) -> Any:
            return self.call((number, argument), self._path)

        weakref.finalize(call, self._drop_remote)
        return call

    def _drop_remote(self) -> None:
        self._remotes -= 1
        self.release()


@atexit.register
def _end_idle() -> None:
    for child in _Child._idle:  # pyright: ignore[reportPrivateUsage]
        child.end()


@dataclass(frozen=True, slots=True)
class _Limit:
    """What a child may take for files of a size."""

    memory: int
    """Bytes."""
    seconds: float
    """Of processor time."""

    @classmethod
    def of(cls, size: int) -> _Limit:
        """The limits for so many bytes."""
        return cls(
            USD_MEMORY + USD_MEMORY_PER_BYTE * size, USD_CPU_SECONDS + USD_CPU_SECONDS_PER_MEGABYTE * size / 2**20
        )

    def timer(self, end: Callable[[], None]) -> threading.Timer:
        """Ends a child that neither finishes nor takes processor time, which the system limits."""
        return _timer(USD_WALL_FACTOR * self.seconds, end)


def _timer(seconds: float, end: Callable[[], None]) -> threading.Timer:
    """Starts a timer that does not keep the program alive."""
    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
    return timer


def _death_error(path: Path, limit: _Limit, status: int) -> FormatError:
    """What to say of a child that has ended; ``status`` is the negative number of the signal, as of `Popen.wait`."""
    if status in (-getattr(signal, "SIGXCPU", 0), -getattr(signal, "SIGKILL", 0)):
        what = f"takes more than {limit.seconds:.0f} s to read, many times what files of its size need"
    else:
        what = f"ends the process that reads it, or takes more than {limit.memory / 2**30:.1f} GB of memory"
    return FormatError(path, f"{what}: damaged, or made to exhaust this machine")


def _size_of(path: Path) -> int:
    """Returns the bytes of a file, 0 of one that is not there."""
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _checked_size(path: Path, file: Path) -> int:
    """Returns the bytes of one of the files that a stage is composed of."""
    if leaves_folder(path, file):
        raise FormatError(path, f"names {os.fspath(file)[:200]!r}, which is not in its folder")
    status = file.stat()
    check_regular(file, status)
    return status.st_size


# --- The child ---


@dataclass(slots=True)
class _Session:
    """The child's side of the reading of a file."""

    input: BinaryIO
    output: BinaryIO
    limit: _Limit
    used: float = 0.0
    """Processor time that was used when the present call began, seconds."""
    remotes: list[Remote] = field(default_factory=list[Remote])
    has_assets: bool = False

    def send(self, kind: str, value: Any) -> None:
        """Sends a message."""
        send(self.output, (kind, value), self._number)

    def _number(self, value: Any) -> int | None:
        """The number of a function that stays here."""
        if not isinstance(value, Remote):
            return None
        self.remotes.append(value)
        return len(self.remotes) - 1

    def begin(self) -> None:
        """Begins a call, which has all of the processor time for itself."""
        self.used = time.process_time()
        self.set_limit(self.limit)

    def set_limit(self, limit: _Limit) -> None:
        """Limits memory, and the processor time of the present call."""
        self.limit = limit
        _limit(limit.memory, self.used + limit.seconds)

    def answer(self, function: Callable[[], Any]) -> None:
        """Sends what a function returns or raises."""
        try:
            self.send("result", function())
        except LumisplatError as error:
            if "std::bad_alloc" in str(error):  # the library's own word for memory that is at its end
                os._exit(1)
            self.send("error", error)
        except MemoryError:
            os._exit(1)
        except BaseException:
            self.send("crash", traceback.format_exc())


_session: _Session | None = None
"""That of this process, if it is a child."""


def request_access(file: Path) -> None:
    """In a child: asks the parent whether a file may be opened, and takes the limits that it sets.

    Args:
        file: One of those that a stage is composed of. In other processes nothing happens.
    """
    if _session is None:
        return
    _session.send("file", file)
    _session.set_limit(receive(_session.input))


def raise_limit_for_asset(size: int) -> None:
    """In a child: raises the limits for a texture or a sky that is about to be decoded.

    Args:
        size: Bytes of its file. In other processes nothing happens.
    """
    if _session is None:
        return
    old, more = _session.limit, _Limit.of(size)
    memory = old.memory + more.memory - USD_MEMORY + (0 if _session.has_assets else USD_ASSETS_MEMORY)
    _session.has_assets = True
    _session.set_limit(_Limit(memory, old.seconds + more.seconds - USD_CPU_SECONDS))
    _session.send("limit", _session.limit)


def serve() -> None:
    """Reads files for the parent process, until that closes the pipe or asks for nothing for some time."""
    stdin, stdout = os.fdopen(os.dup(0), "rb", buffering=0), os.fdopen(os.dup(1), "wb", buffering=0)
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(nowhere, descriptor)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    importlib.import_module("lumisplat.io.usd.animation")  # what requests need, loaded once
    importlib.import_module("lumisplat.io.usd.library").pxr()
    while _wait_for_request(stdin):
        try:
            request: _Request = receive(stdin)
        except EOFError:
            return
        if not _FORKS:
            _read(request, stdin, stdout)
            return
        process = os.fork()
        if process == 0:
            _read(request, stdin, stdout)
        _, status = os.waitpid(process, 0)
        send(stdout, ("ended" if status == 0 else "died", status & 0x7F))


def _wait_for_request(stdin: BinaryIO) -> bool:
    """Waits for a request."""
    if not _FORKS:
        return True
    import select

    return bool(select.select([stdin], [], [], USD_IDLE_SECONDS)[0])


def _read(request: _Request, stdin: BinaryIO, stdout: BinaryIO) -> NoReturn:
    """Reads a file, and answers until nothing more is asked; then the process ends."""
    global _session  # noqa: PLW0603
    session = _session = _Session(stdin, stdout, request.limit)
    try:
        session.send("reader", os.getpid())
        session.begin()
        os.chdir(request.folder)
        _log.setLevel(request.level)
        _log.propagate = False
        _log.addHandler(_LogForwarder(session))
        function = getattr(importlib.import_module(request.module), request.function)
        with references_outside(request.allow_outside):
            session.answer(lambda: function(request.path, *request.arguments))
            while isinstance(more := receive(stdin), tuple):
                number, argument = cast(tuple[int, float], more)
                session.begin()
                session.answer(lambda: session.remotes[number](argument))  # noqa: B023
        os._exit(0)
    except (EOFError, OSError, MemoryError):
        os._exit(1)


def _limit(memory: int, seconds: float) -> None:
    """Limits the memory and the whole processor time of this process, where the system can."""
    try:
        import resource
    except ImportError:
        return
    until = int(seconds) + 1
    for kind, most in ((resource.RLIMIT_DATA, memory), (resource.RLIMIT_CPU, until), (resource.RLIMIT_CORE, 0)):
        hard = resource.getrlimit(kind)[1]
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


class _LogForwarder(logging.Handler):
    """Sends log lines to the parent."""

    def __init__(self, session: _Session) -> None:
        super().__init__()
        self._session = session

    def emit(self, record: logging.LogRecord) -> None:
        self._session.send("log", (record.levelno, "%s", record.getMessage()))


# --- Messages ---


def send(stream: BinaryIO, value: Any, number_of: Callable[[Any], int | None] | None = None) -> None:
    """Writes a value to a pipe: the number of its parts, and each part after its length.

    Args:
        stream: The pipe.
        value: What can be pickled; arrays are parts of their own, and not copied.
        number_of: Returns the number of what stays here.
    """
    data, buffers = io.BytesIO(), list[pickle.PickleBuffer]()
    pickler = pickle.Pickler(data, 5, buffer_callback=buffers.append)
    if number_of is not None:
        pickler.persistent_id = number_of
    pickler.dump(value)
    parts = [data.getbuffer(), *(buffer.raw() for buffer in buffers)]
    _write(stream, struct.pack("<Q", len(parts)))
    for part in parts:
        _write(stream, struct.pack("<Q", len(part)))
        _write(stream, part)
    stream.flush()


def receive(stream: BinaryIO, load: Callable[[int], Any] | None = None) -> Any:
    """Reads a value that `send` has written. Arrays are read-only.

    Raises:
        EOFError: The pipe is closed.
    """
    (count,) = struct.unpack("<Q", _read_exactly(stream, 8))
    parts: list[bytes] = []
    for _ in range(count):
        (length,) = struct.unpack("<Q", _read_exactly(stream, 8))
        parts.append(_read_exactly(stream, length))
    unpickler = pickle.Unpickler(io.BytesIO(parts[0]), buffers=parts[1:])
    if load is not None:
        unpickler.persistent_load = load
    return unpickler.load()


def _write(stream: BinaryIO, data: bytes | memoryview) -> None:
    view = memoryview(data)
    while view:
        view = view[stream.write(view) :]


def _read_exactly(stream: BinaryIO, length: int) -> bytes:
    """Reads so many bytes, and no more: another process may read what follows."""
    parts: list[bytes] = []
    while length:
        part = stream.read(min(length, 2**20))
        if not part:
            raise EOFError
        parts.append(part)
        length -= len(part)
    return parts[0] if len(parts) == 1 else b"".join(parts)
