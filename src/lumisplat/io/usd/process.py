"""Reads OpenUSD files in a child process with limits on memory and processor time.

The USD library trusts the sizes in a file: a crafted file can take all memory, run for hours or crash the process. The
child process therefore reads the file and sends only the result. The child asks the parent before it opens a layer, and
the parent checks the layer's path. Where processes can fork, one child loads the library, waits for requests and forks
for each request, so that only the first request pays for loading.
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
"""Memory in bytes that a child process may take to read a file of 0 bytes; `USD_MEMORY_PER_BYTE` adds to it.

usd-core and Warp take 0.2 GB."""

USD_ASSETS_MEMORY = 2 * 2**30
"""Bytes added to a child's memory limit once, at a file's first texture. `TEXTURE_BYTES_FREE` also limits textures."""

USD_MEMORY_PER_BYTE = 40
"""Bytes added to a child's memory limit for each byte of layers and textures.

Numbers of 8 characters become doubles, and usd-core holds three copies of them."""

USD_CPU_SECONDS = 30
"""Processor time in seconds that a child process may take for a file of 0 bytes.

`USD_CPU_SECONDS_PER_MEGABYTE` adds to it. A crafted file with references nested 16 deep took minutes."""

USD_CPU_SECONDS_PER_MEGABYTE = 1.0
"""Seconds added to a child's processor time limit for each 2^20 bytes of files. Reading 2^20 bytes takes 0.1 s."""

USD_WALL_FACTOR = 10.0
"""Elapsed time that a child process may take, as a multiple of its processor time limit. The factor is large because
machines may be busy."""

USD_START_SECONDS = 300.0
"""Elapsed time in seconds that a child may take to import usd-core, which takes 0.2 s on an idle machine."""

USD_IDLE_SECONDS = 60.0
"""Seconds without a request after which a child process that reads OpenUSD files ends."""

_log = logging.getLogger("lumisplat")

_START = "import sys; sys.path[:] = sys.argv[1:]; from lumisplat.io.usd.process import serve; serve()"
"""Python program of a child process. Modules are imported from the parent's path, never from the working folder."""

_FORKS = hasattr(os, "fork") and sys.platform != "darwin"
"""True if a child forks for each request, so that usd-core is imported once; False on macOS and Windows.

On macOS system libraries do not survive a fork."""


@dataclass(frozen=True, slots=True)
class _Request:
    """Request to a child process: the function to call, its arguments and its limits."""

    module: str
    function: str
    arguments: tuple[Any, ...]
    path: Path
    folder: str
    """Working folder of the parent, from which relative paths start."""
    allow_outside: bool
    limit: _Limit
    """Limits on memory and time before the parent has allowed any layer; each allowed layer raises them."""
    level: int
    """Lowest level of log records that the parent's logger emits. The child sends no records below this level."""


def read_in_child(path: PathLike, function: Callable[..., Any], *arguments: Any) -> Any:
    """Calls a function that reads an OpenUSD file in a child process, and returns its result.

    Args:
        path: The file.
        function: A module-level function, called with ``Path(path)`` and ``arguments``.
        *arguments: Further arguments. Each `Remote` in the result stays in the child, which lives until the parent
            drops the last of them.

    Raises:
        FormatError: The function raised it; or the child crashed, or took more memory or time than a file of this size
            needs.
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
    """A function of one argument that stays in the child process; the parent gets a proxy that calls it there.

    Args:
        function: The function.
    """

    def __init__(self, function: Callable[[float], Any]) -> None:
        self._function = function

    def __call__(self, argument: float) -> Any:
        """Calls the function in this process."""
        return self._function(argument)


# --- The parent ---


class _Child:
    """A child process that reads OpenUSD files, as seen by the parent: pipes, limits and the current request."""

    _idle: list[_Child] = []  # noqa: RUF012
    _lock = threading.RLock()  # `_drop_remote` may run at any time, also within `acquire`

    def __init__(self) -> None:
        home = os.fspath(Path(__file__).parents[3])  # the folder from which the parent imports this package
        paths = dict.fromkeys([*(path for path in sys.path if path), home])
        env = os.environ | {"MALLOC_ARENA_MAX": "2", "OPENBLAS_NUM_THREADS": "1"}
        env.pop("PXR_AR_DEFAULT_SEARCH_PATH", None)  # assets are searched only relative to the layer that names them
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _START, *paths],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=env,
        )
        self._in, self._out = cast(BinaryIO, self._process.stdin), cast(BinaryIO, self._process.stdout)
        self._reader = 0
        """Id of the process that reads the current file: the child or its fork; 0 if no file is being read."""
        self._limit = _Limit.of(0)
        """Memory and time limits of the child for the current file."""
        self._size = 0
        """Total size in bytes of those layers of the current file that the child has asked to open."""
        self._calls = threading.Lock()
        self._remotes = 0
        """Number of functions in the child for which the parent still holds a proxy; see `Remote`."""
        self._path = Path()

    @classmethod
    def acquire(cls) -> _Child:
        """Returns an idle child process, or starts one."""
        with cls._lock:
            while cls._idle:
                child = cls._idle.pop()
                if child._process.poll() is None:
                    return child
                child.end()
        return cls()

    def release(self) -> None:
        """Ends the current request and makes the child idle, unless the parent still holds a proxy for a `Remote`."""
        if self._remotes:
            return
        with contextlib.suppress(OSError, EOFError, ValueError):  # the child may have ended and its pipes be closed
            if self._reader:
                self._send("done")
            if self._reader and _FORKS and self._receive()[0] == "ended":
                self._reader = 0
                with self._lock:
                    self._idle.append(self)
                return
        self.end()

    def end(self) -> None:
        """Kills the child process and the process that it forked, and closes the pipes."""
        with contextlib.suppress(OSError):
            if self._reader and self._reader != self._process.pid and self._process.poll() is None:
                os.kill(self._reader, signal.SIGKILL)
        self._process.kill()
        for stream in (self._in, self._out):
            with contextlib.suppress(OSError):
                stream.close()
        self._process.wait()

    def call(self, request: _Request | tuple[int, float], path: Path) -> Any:
        """Sends a request or calls a function that stays in the child, and returns the result.

        Args:
            request: A request to read a file, or the number of a `Remote` and its argument.
            path: The file, named in errors.

        Raises:
            FormatError: See `read_in_child`.
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
            except (EOFError, OSError, ValueError):  # ValueError: `end` closed the pipes
                if not self._reader:
                    raise FormatError(path, "cannot be read: the OpenUSD reader process did not start") from None
                self._process.kill()
                raise _death_error(path, limit, self._process.wait()) from None
            except KeyboardInterrupt:  # nobody waits for the answer now
                self.end()
                raise

    def _begin(self, request: _Request | tuple[int, float]) -> _Limit:
        """Returns the limits for a call. A request for a file first resets the limits and sizes of the last file."""
        if isinstance(request, _Request):
            self._reader, self._size, self._limit = 0, 0, request.limit
        return self._limit

    def _update_limit(self, kind: str, value: Any) -> None:
        """Handles a message of the child.

        Args:
            kind: "reader" if the child forked, "file" if it asks for a layer, "limit" if it raised its limit for a
                texture.
            value: Id of the forked process, path of the layer, or the raised limit.
        """
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
        """Returns a proxy that calls the child's `Remote` with this number, and reserves the child for this proxy."""
        self._remotes += 1

        def call(argument: float) -> Any:
            return self.call((number, argument), self._path)

        weakref.finalize(call, self._drop_remote)
        return call

    def _drop_remote(self) -> None:
        """Decrements the number of proxies of `Remote` functions, and releases the child process when none is left."""
        self._remotes -= 1
        self.release()


@atexit.register
def _end_idle() -> None:
    """Ends all idle child processes when the program exits."""
    for child in _Child._idle:  # pyright: ignore[reportPrivateUsage]
        child.end()


@dataclass(frozen=True, slots=True)
class _Limit:
    """Limits on the memory and processor time that a child process may use to read a file."""

    memory: int
    """Memory in bytes."""
    seconds: float
    """Processor time in seconds."""

    @classmethod
    def of(cls, size: int) -> _Limit:
        """Returns the limits for reading files with a total size of ``size`` bytes."""
        return cls(
            USD_MEMORY + USD_MEMORY_PER_BYTE * size, USD_CPU_SECONDS + USD_CPU_SECONDS_PER_MEGABYTE * size / 2**20
        )

    def timer(self, end: Callable[[], None]) -> threading.Timer:
        """Starts a timer that ends a hanging child, by ``end``, after `USD_WALL_FACTOR` times ``seconds``."""
        return _timer(USD_WALL_FACTOR * self.seconds, end)


def _timer(seconds: float, end: Callable[[], None]) -> threading.Timer:
    """Starts a timer that calls ``end`` after some seconds; its daemon thread does not keep the program alive."""
    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
    return timer


def _death_error(path: Path, limit: _Limit, status: int) -> FormatError:
    """Returns the error about a child process that ended while it read ``path``: out of memory, time, or crashed.

    Args:
        path: The file.
        limit: Limits of the child.
        status: Exit status as from `Popen.wait`: negative for a signal.
    """
    if status in (-getattr(signal, "SIGXCPU", 0), -getattr(signal, "SIGKILL", 0)):
        what = f"takes more than {limit.seconds:.0f} s to read, many times what files of its size need"
    else:
        what = f"crashes the process that reads it, or takes more than {limit.memory / 2**30:.1f} GB of memory"
    return FormatError(path, f"{what}: damaged, or made to exhaust this machine")


def _size_of(path: Path) -> int:
    """Returns the size of a file in bytes, 0 if it does not exist."""
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _checked_size(path: Path, file: Path) -> int:
    """Returns the size in bytes of ``file``, a layer that the child wants to open for the stage ``path``.

    Raises:
        FormatError: The layer is outside of the stage's folder, or is no regular file.
    """
    if leaves_folder(path, file):
        raise FormatError(
            path,
            f"names {os.fspath(file)[:200]!r}, which is not in its folder: move it there, or trust the file by "
            "--allow-outside (allow_outside=True)",
        )
    status = file.stat()
    check_regular(file, status)
    return status.st_size


# --- The child ---


@dataclass(slots=True)
class _Session:
    """State of one request in the child process: the pipes to the parent, the limits and the remote functions."""

    input: BinaryIO
    output: BinaryIO
    limit: _Limit
    used: float = 0.0
    """Processor time in seconds that this process had used before the current call; the call's limit excludes it."""
    remotes: list[Remote] = field(default_factory=list[Remote])
    has_assets: bool = False

    def send(self, kind: str, value: Any) -> None:
        """Sends the parent a message: its kind, such as "result", and a value."""
        send(self.output, (kind, value), self._number)

    def _number(self, value: Any) -> int | None:
        """Keeps a `Remote` in the child and returns a number by which the parent calls it; None for other values."""
        if not isinstance(value, Remote):
            return None
        self.remotes.append(value)
        return len(self.remotes) - 1

    def begin(self) -> None:
        """Starts a call: sets the processor time limit anew, so that earlier calls do not count."""
        self.used = time.process_time()
        self.set_limit(self.limit)

    def set_limit(self, limit: _Limit) -> None:
        """Limits the memory and the processor time of the current call."""
        self.limit = limit
        _limit(limit.memory, self.used + limit.seconds)

    def answer(self, function: Callable[[], Any]) -> None:
        """Calls a function and sends the parent its result or its exception."""
        try:
            self.send("result", function())
        except LumisplatError as error:
            if "std::bad_alloc" in str(error):  # how the library reports that memory is exhausted
                os._exit(1)
            self.send("error", error)
        except MemoryError:
            os._exit(1)
        except BaseException:
            self.send("crash", traceback.format_exc())


_session: _Session | None = None
"""Session of this process if it is a child that reads OpenUSD files; None in all other processes."""


def request_access(file: Path) -> None:
    """Asks the parent process for permission to open a layer, and applies the raised limits that the parent returns.

    Does nothing outside of the child process that reads OpenUSD files.

    Args:
        file: A layer file of the stage.
    """
    if _session is None:
        return
    _session.send("file", file)
    _session.set_limit(receive(_session.input))


def raise_limit_for_asset(size: int) -> None:
    """Raises the child process's limits before it decodes a texture or an environment image.

    Does nothing outside of the child process that reads OpenUSD files.

    Args:
        size: Size of the encoded file in bytes.
    """
    if _session is None:
        return
    old, more = _session.limit, _Limit.of(size)
    memory = old.memory + more.memory - USD_MEMORY + (0 if _session.has_assets else USD_ASSETS_MEMORY)
    _session.has_assets = True
    _session.set_limit(_Limit(memory, old.seconds + more.seconds - USD_CPU_SECONDS))
    _session.send("limit", _session.limit)


def serve() -> None:
    """Answers requests of the parent until the pipe closes or no request arrives for `USD_IDLE_SECONDS`."""
    stdin, stdout = os.fdopen(os.dup(0), "rb", buffering=0), os.fdopen(os.dup(1), "wb", buffering=0)
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(nowhere, descriptor)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl C
    importlib.import_module("lumisplat.io.usd.animation")  # preloaded once for all requests
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
    """Waits for a request; returns False after `USD_IDLE_SECONDS` without one."""
    if not _FORKS:
        return True
    import select

    return bool(select.select([stdin], [], [], USD_IDLE_SECONDS)[0])


def _read(request: _Request, stdin: BinaryIO, stdout: BinaryIO) -> NoReturn:
    """Reads the file of a request, answers calls of its remote functions until the parent is done, and exits."""
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
    """Limits memory in bytes and total processor time in seconds of this process, on systems that support it."""
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
    """Logging handler of a child process that sends log records to the parent, which emits them."""

    def __init__(self, session: _Session) -> None:
        super().__init__()
        self._session = session

    def emit(self, record: logging.LogRecord) -> None:
        self._session.send("log", (record.levelno, "%s", record.getMessage()))


# --- Messages ---


def send(stream: BinaryIO, value: Any, number_of: Callable[[Any], int | None] | None = None) -> None:
    """Writes a value to a pipe by pickle: the number of byte strings, then each byte string after its length.

    Args:
        stream: The pipe.
        value: A picklable value. Each array becomes a separate byte string and is not copied.
        number_of: Returns a number for an object that stays in this process, and None for all other objects. The number
            is sent in place of the object. Without this function, all objects are sent.
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
    """Reads a value that `send` wrote; arrays in the value are read-only.

    Args:
        stream: The pipe.
        load: Returns the object for a number that `send` wrote in place of an object. Not needed without such numbers.

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
    """Reads exactly ``length`` bytes and never more, because another process may read the bytes that follow."""
    parts: list[bytes] = []
    while length:
        part = stream.read(min(length, 2**20))
        if not part:
            raise EOFError
        parts.append(part)
        length -= len(part)
    return parts[0] if len(parts) == 1 else b"".join(parts)
