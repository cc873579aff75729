"""The server of the page: viser's, with its door guarded, its messages filtered and its sharing off."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import threading
import warnings
from collections.abc import Awaitable, Callable, Generator
from typing import TYPE_CHECKING, Any

import lumisplat as ls
from lumisplat.viewer.server.guard import Guard
from lumisplat.viewer.server.messages import FilteredConnection
from lumisplat.viewer.server.page_additions import with_additions
from lumisplat.viewer.server.wakeups import let_threads_push

if TYPE_CHECKING:
    import viser

_log = logging.getLogger("lumisplat.pages")

_SERVE = threading.Lock()
"""Held while the function by which viser opens its port is replaced."""


def import_viser() -> Any:
    """The package viser.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        import viser
    except ImportError:
        raise ls.MissingExtraError("the viewer", "view") from None
    let_threads_push()
    return viser


class PageServer:
    """Listens on a port for pages of the viewer.

    Args:
        host: Address to listen on; a loopback one is reached from this machine alone.
        port: Port; 0: a free one.

    Raises:
        MissingExtraError: viser is not installed.
        DeviceError: The port cannot be opened, or viser did not ask the guard.
    """

    def __init__(self, host: str, port: int) -> None:
        viser = import_viser()
        # A page may go at any moment: what was on its way to it is no news.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        listener = listening_socket(host, port)
        self._is_open = True
        self.guard = Guard(host, listener.getsockname()[1])
        with _guarded(listener, self.guard, lambda: self._is_open) as asked, _quiet():
            self.viser: viser.ViserServer = viser.ViserServer(host=host, port=self.guard.port, verbose=False)
        if not asked:
            self.close()
            listener.close()
            raise ls.DeviceError(
                "this version of viser opens its port in another way, unguarded: pip install viser==1.1.1"
            )
        self.viser.request_share_url = _refuse_to_share  # pyright: ignore[reportAttributeAccessIssue]
        self.viser.get_event_loop().set_exception_handler(_report)
        self.viser.gui.main_panel.dock_right()  # beside the picture, which it would hide
        self.set_theme(dark=True)

    def set_theme(self, *, dark: bool) -> None:
        """Makes all pages dark or light."""
        self.viser.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=dark)

    def close(self) -> None:
        """Closes the port and all pages' connections; what they have just asked for is dropped without a word."""
        loop = self.viser.get_event_loop()
        loop.set_exception_handler(_say_nothing)
        self._is_open = False
        asyncio.run_coroutine_threadsafe(_drop_what_was_asked_for(), loop).result()
        with _quiet():
            self.viser.stop()


def listening_socket(host: str, port: int) -> socket.socket:
    """A socket that listens.

    Raises:
        DeviceError: The address or the port cannot be had; the message says what to do.
    """
    if not 0 <= port < 2**16:
        raise ls.DeviceError(f"port {port} is none, expected 1 to 65535, or 0 for a free one")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host.strip("[]"), port), family=family)
    except OSError as error:
        reason = error.strerror or error
        raise ls.DeviceError(f"port {port} of {host} cannot be opened ({reason}): --port 0 takes a free one") from None


@contextlib.contextmanager
def _guarded(listener: socket.socket, guard: Guard, is_heard: Callable[[], bool]) -> Generator[list[bool]]:
    """While it lasts, what viser opens is this socket, behind the guard; the list is not empty once it has."""
    import websockets.asyncio.server as door

    real: Any = door.serve
    asked: list[bool] = []

    def serve(handler: Callable[[Any], Awaitable[None]], *_: object, **options: Any) -> Any:
        inner = options.pop("process_request")
        asked.append(True)

        def check(connection: Any, request: Any) -> Any:
            refused = guard.refusal(request.path, request.headers)
            if refused is not None:
                return connection.respond(*refused)
            response = inner(connection, request)
            if response is not None:
                if response.headers.get("Content-Type", "").startswith("text/html"):
                    packed = response.headers.get("Content-Encoding") == "gzip"
                    response.body = with_additions(response.body, is_packed=packed)
                    del response.headers["Content-Length"]
                    response.headers["Content-Length"] = str(len(response.body))
                response.headers["Referrer-Policy"] = "no-referrer"
                if guard.token_of(request.path):
                    response.headers["Set-Cookie"] = guard.set_cookie()
            return response

        async def handle(connection: Any) -> None:
            await handler(FilteredConnection(connection, is_heard))

        return real(handle, sock=listener, process_request=check, **options)

    with _SERVE:
        door.serve = serve  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield asked
        finally:
            door.serve = real


@contextlib.contextmanager
def _quiet() -> Generator[None]:
    """Keeps viser's own lines off standard output, which has the viewer's address alone, and out of notebooks."""
    import rich

    console = rich.get_console()
    console.quiet, before = True, console.quiet
    try:
        yield
    finally:
        console.quiet = before


def _refuse_to_share(verbose: bool = True) -> None:
    """In place of the tunnel to a public server."""
    _log.warning("a page asked to be shared with the world, which the viewer does not do")


async def _drop_what_was_asked_for() -> None:
    """Ends the tasks of messages that pages have sent, also those that wait for their turn, while the loop runs."""
    names = ("WebsockMessageHandler._handle_incoming_message", "in_turn.<locals>.callback")
    asked = [task for task in asyncio.all_tasks() if getattr(task.get_coro(), "__qualname__", "") in names]
    for task in asked:
        task.cancel()
    await asyncio.gather(*asked, return_exceptions=True)


def _say_nothing(_: object, context: dict[str, Any]) -> None:
    """In place of `_report`, once nobody is there to read it."""


def _report(_: object, context: dict[str, Any]) -> None:
    """A page's message that viser cannot take: one line instead of a traceback."""
    _log.warning("a page's message was dropped: %s", context.get("exception") or context.get("message"))
