"""The page server: viser with access control, validated messages, and its own style and script."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import logging
import socket
import threading
import warnings
from collections.abc import Awaitable, Callable, Generator
from dataclasses import field, make_dataclass
from functools import cache, lru_cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

import lumisplat as ls
from lumisplat.viewer.server.event_queue import finish_event
from lumisplat.viewer.server.guard import FilteredConnection, Guard
from lumisplat.viewer.thresholds import CLOSE_S

if TYPE_CHECKING:
    import viser


_log = logging.getLogger("lumisplat.pages")

_SERVE = threading.Lock()
"""Lock held while ``websockets.serve`` is replaced by a version with access control, so that viser calls the latter."""


def import_viser() -> Any:
    """Imports viser and patches its message buffers for use from several threads.

    Raises:
        MissingExtraError: viser is not installed.
    """
    try:
        import viser
    except ImportError:
        raise ls.errors.MissingExtraError("the viewer", "view") from None
    make_message_buffers_thread_safe()
    camera_stopped_message()  # before viser lists the types of messages, when the first one arrives
    return viser


class PageServer:
    """Serves the pages of a viewer on a port.

    Args:
        host: Address to listen on; a loopback address is reachable only from this machine.
        port: Port to listen on; 0 takes a free one.

    Raises:
        MissingExtraError: viser is not installed.
        DeviceError: The port cannot be opened, or the installed viser bypasses the access control.
    """

    def __init__(self, host: str, port: int) -> None:
        viser = import_viser()
        # A page may close at any moment; undelivered messages need no warning.
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
                "this version of viser bypasses the access control of its port: pip install viser==1.1.1"
            )
        self.viser.request_share_url = _refuse_to_share  # pyright: ignore[reportAttributeAccessIssue]
        self.viser.get_event_loop().set_exception_handler(_report)
        self.viser.gui.main_panel.dock_right()  # beside the image, not over it
        self.set_theme(dark=True)

    def set_theme(self, *, dark: bool) -> None:
        """Sets the dark or light theme on all pages."""
        self.viser.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=dark)

    def on_camera_stopped(self, client: viser.ClientHandle, act: Callable[[], object]) -> None:
        """Calls ``act`` whenever a page says that its camera has stopped; in the server's event loop, so be brief."""
        connection: Any = client._websock_connection  # pyright: ignore[reportPrivateUsage]

        def handle(*_: object) -> None:
            act()

        connection.register_handler(camera_stopped_message(), handle)

    def close(self) -> None:
        """Closes the port and all connections; finishes the event it handles, and drops all that wait."""
        loop = self.viser.get_event_loop()
        loop.set_exception_handler(_ignore)
        self._is_open = False
        asyncio.run_coroutine_threadsafe(_drop_pending_events(), loop).result()
        with _quiet():
            self.viser.stop()


def listening_socket(host: str, port: int) -> socket.socket:
    """Opens a listening socket.

    Raises:
        DeviceError: The address or the port is invalid or not available.
    """
    if not 0 <= port < 2**16:
        raise ls.DeviceError(f"port is {port}, expected 1 to 65535, or 0 for a free port")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host.strip("[]"), port), family=family)
    except OSError as error:
        reason = error.strerror or error
        raise ls.DeviceError(f"port {port} of {host} cannot be opened ({reason}): --port 0 uses a free port") from None


@contextlib.contextmanager
def _guarded(listener: socket.socket, guard: Guard, is_accepting: Callable[[], bool]) -> Generator[list[bool]]:
    """Context in which a viser server that starts listens on ``listener``, with access control and message checks.

    The yielded list is empty at first; it has an element once viser has opened its server this way.

    Args:
        listener: Socket to listen on.
        guard: Checks each HTTP request.
        is_accepting: Returns False once the server closes; messages are then ignored.
    """
    import websockets.asyncio.server as websockets_server

    real: Any = websockets_server.serve
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
            await handler(FilteredConnection(connection, is_accepting))

        return real(handle, sock=listener, process_request=check, **options)

    with _SERVE:
        websockets_server.serve = serve  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield asked
        finally:
            websockets_server.serve = real


@contextlib.contextmanager
def _quiet() -> Generator[None]:
    """Context in which viser prints nothing, so that standard output contains only the viewer's address."""
    import rich

    console = rich.get_console()
    console.quiet, before = True, console.quiet
    try:
        yield
    finally:
        console.quiet = before


def _refuse_to_share(verbose: bool = True) -> None:
    """Takes the place of viser's function that opens a tunnel to a public server: logs a warning instead."""
    _log.warning("a page asked for a public share URL, which the viewer does not support")


async def _drop_pending_events() -> None:
    """Cancels all asyncio tasks that handle or queue page messages, and waits for the one that a thread handles.

    Runs in the server's event loop, which must go on until then: where an event sets a control, the control's callback
    runs in the loop.
    """
    names = ("WebsockMessageHandler._handle_incoming_message", "queued_callback.<locals>.callback")
    asked = [task for task in asyncio.all_tasks() if getattr(task.get_coro(), "__qualname__", "") in names]
    for task in asked:
        task.cancel()
    await asyncio.gather(*asked, return_exceptions=True)
    await finish_event(CLOSE_S)


def _ignore(_: object, context: dict[str, Any]) -> None:
    """Event-loop exception handler that discards errors while the server closes."""


def _report(_: object, context: dict[str, Any]) -> None:
    """Event-loop exception handler: logs a page message that viser cannot handle, in one line without traceback."""
    _log.warning("a page's message was dropped: %s", context.get("exception") or context.get("message"))


TITLE = "Lumisplat"

_STYLE = """
/* Shows labels and numbers in full; viser narrows letters and reserves more space for arrows than for numbers. */
label, .mantine-Text-root, .mantine-Input-input { letter-spacing: normal !important; }
label { font-size: 0.8125rem; }
.mantine-NumberInput-controls { display: none !important; }
.mantine-NumberInput-input { padding: 0 0.35em !important; font-size: 0.75rem !important; }
.mantine-Input-input:disabled, .mantine-Input-input[data-disabled] { opacity: 0.4 !important; }
.mantine-Slider-root + .mantine-NumberInput-root { width: 4.25rem !important; }
/* Hides tooltips over an open dropdown. */
body:has(.mantine-Select-dropdown:not([style*="display: none"])) .mantine-Tooltip-tooltip { display: none !important; }
.lumi-command { box-sizing: border-box; width: calc(100% - 1.25rem); margin: 0 0.625rem 0.5em; font: 0.8rem monospace; }
/* Hides the text controls that receive clicks in lists. */
div:has(> .mantine-Flex-root label:empty):has(.mantine-TextInput-input) { display: none !important; }
.lumi-list { padding: 0 0.5em 0.3em; font-size: 0.875em; overflow-wrap: anywhere; }
.lumi-row { display: flex; align-items: center; gap: 0.5em; padding: 0.15em 0.4em; border-radius: 4px; }
.lumi-row[data-command], .lumi-row [data-command] { cursor: pointer; }
.lumi-row[data-command]:hover, .lumi-row [data-command]:hover { background: rgba(128, 128, 128, 0.2); }
.lumi-row.selected { background: rgba(255, 176, 32, 0.22); font-weight: 600; }
.lumi-row.hidden > .lumi-name { opacity: 0.45; text-decoration: line-through; }
.lumi-name { flex-grow: 1; }
.lumi-key .lumi-name { white-space: nowrap; }
.lumi-row svg { width: 1.15em; height: 1.15em; flex-shrink: 0; display: block; }
.lumi-row span[data-command]:not(.lumi-name) { padding: 0.2em; border-radius: 4px; opacity: 0.4; }
.lumi-row span[data-command].on, .lumi-row span[data-command]:hover { opacity: 1 !important; }
.lumi-detail { opacity: 0.6; font-size: 0.85em; padding: 0 0.4em 0 2.1em; }
.lumi-problem { color: #e5534b; padding: 0.2em 0.4em; }
.lumi-keys { display: flex; flex-wrap: wrap; gap: 0.4em; padding: 0 0.5em 0.4em; font-size: 0.8em; }
.lumi-key { width: 7.2em; border-radius: 4px; overflow: hidden; background: rgba(128, 128, 128, 0.15); }
.lumi-key img { display: block; width: 100%; cursor: pointer; }
.lumi-key img:hover { opacity: 0.85; }
.lumi-key .lumi-row { padding: 0 0.2em; gap: 0; }
/* Message over the image area until the first image. */
.lumi-wait { position: fixed; z-index: 5; left: calc(0.5 * (100vw - var(--lumi-panel, 0px)));
  top: calc(0.5 * (100vh - var(--lumi-drawer, 0px))); transform: translate(-50%, -50%);
  width: min(22rem, 70vw); padding: 0.9em 1.2em; border-radius: 8px; color: #eee;
  background: rgba(20, 20, 20, 0.82); pointer-events: none; text-align: center; overflow-wrap: anywhere; }
.lumi-wait i { display: block; height: 4px; margin-top: 0.7em; border-radius: 2px; background: #555; }
.lumi-wait b { display: block; height: 4px; border-radius: 2px; background: #4dabf7; transition: width 0.2s; }
/* Phones: the panel is a full-width drawer, and the image fills the rest. */
@media (max-width: 36em) {
  .mantine-Paper-root[style*="bottom: 0"] { width: 100% !important; max-height: 50% !important; }
  .mantine-Paper-root[style*="bottom: 0"] [style*="width: 20em"] { width: 100% !important; }
  div[data-lumi-canvas] { height: calc(100% - var(--lumi-drawer, 0px)) !important; }
}
"""

_SCRIPT = """
const setValue = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set;
let sent = 0;
// Types the data-command of a clicked element into the text control that data-to names.
function sendCommand(element) {
  const to = element.closest('[data-to]');
  const label = to && document.querySelector(`label[for="${to.dataset.to}"]`);
  const input = label && label.closest('.mantine-Flex-root').querySelector('input');
  if (!input) return;
  setValue.call(input, `${element.dataset.command} ${++sent}`);
  input.dispatchEvent(new Event('input', {bubbles: true}));
}
document.addEventListener('click', (event) => {
  const element = event.target.closest && event.target.closest('[data-command]');
  if (element) sendCommand(element);
});
document.addEventListener('keydown', (event) => {
  if (event.key === 'Enter' && event.target.dataset && event.target.dataset.command) sendCommand(event.target);
});
// Adjusts elements that CSS cannot select or measure.
function arrange() {
  for (const note of document.querySelectorAll('.mantine-Notification-root')) {
    // The server renders the images; the browser draws only gizmos, so software WebGL is fast enough.
    if (note.textContent.startsWith('Software WebGL')) note.querySelector('button')?.click();
  }
  const drawer = document.querySelector('.mantine-Paper-root[style*="position: fixed"][style*="bottom: 0"]');
  const canvas = document.querySelector('canvas');
  const box = canvas && canvas.closest('[style*="flex-grow: 1"][style*="height: 100%"]');
  if (box && !box.dataset.lumiCanvas) box.dataset.lumiCanvas = 'yes';
  measure('--lumi-drawer', drawer ? drawer.offsetHeight : 0);
  measure('--lumi-panel', canvas ? innerWidth - canvas.getBoundingClientRect().width : 0);
}
function measure(name, pixels) {
  const style = document.documentElement.style;
  if (style.getPropertyValue(name) !== `${pixels}px`) style.setProperty(name, `${pixels}px`);
}
// Says when the camera has stopped: no pointer holds it, it rests, and viser, which delays poses, has sent the last.
let watched = null, moves = false, isUnsent = false, sentPose = '';
const pose = () => [...watched.camera.position, ...watched.camera.quaternion].join();
function end() {
  if (!moves && !isUnsent && !watched.currentAction) window.__viserMutable.sendMessage({type: 'CameraStoppedMessage'});
}
function watchCamera() {
  const mutable = window.__viserMutable, controls = mutable && mutable.cameraControl;
  if (!controls || controls === watched) return;
  if (!watched) watchMessages(mutable);
  watched = controls;
  // viser hears of the update first, and may have sent the pose.
  controls.addEventListener('update', () => { moves = true; isUnsent = sentPose !== pose(); });
  controls.addEventListener('sleep', () => { moves = false; end(); });
  controls.addEventListener('controlend', end);
}
function watchMessages(mutable) {
  let send = mutable.sendMessage;
  const watch = (message) => {
    send(message);
    if (message.type !== 'ViewerCameraMessage') return;
    sentPose = pose();
    if (!isUnsent) return;
    isUnsent = false;
    end();
  };
  Object.defineProperty(mutable, 'sendMessage', {get: () => watch, set: (to) => { send = to; }});
}
let waits = false;
new MutationObserver(() => {
  if (waits) return;
  waits = true;
  setTimeout(() => { waits = false; arrange(); watchCamera(); }, 60);
}).observe(document, {subtree: true, childList: true, attributes: true, attributeFilter: ['style', 'class']});
addEventListener('resize', arrange);
"""


@lru_cache(maxsize=2)
def with_additions(body: bytes, *, is_packed: bool) -> bytes:
    """Returns viser's HTML page with the viewer's title, style and script.

    Args:
        body: The HTML.
        is_packed: True if the HTML is compressed with gzip; the result then is, too.
    """
    page = gzip.decompress(body) if is_packed else body
    head = f"<title>{TITLE}</title><style>{_STYLE}</style><script>{_SCRIPT}</script>"
    page = page.replace(b"<title>Viser</title>", head.encode(), 1)
    return gzip.compress(page) if is_packed else page


@cache
def camera_stopped_message() -> Any:
    """Returns the type of a page's message, without fields, that the camera which it sent last is where it stays."""
    base: Any = import_module("viser._messages").Message
    flags = {"include_in_scene_serialization": False}
    return make_dataclass("CameraStoppedMessage", [], bases=(base,), namespace=flags)


class AnyThreadEvent(asyncio.Event):
    """Version of ``asyncio.Event`` whose `set` is safe in any thread; only the event loop wakes the waiters.

    viser sets its events twice for each message, the second time in the event loop. ``asyncio.Event.set`` in another
    thread would iterate over the waiters while the loop changes them: "deque mutated during iteration".
    """

    def set(self) -> None:
        """Marks the event as set; if called in the event loop, also wakes the waiters."""
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            self._value = True
            return
        self._value = False  # otherwise no waiter would be woken
        super().set()


@cache
def make_message_buffers_thread_safe() -> None:
    """Patches viser so that its message buffers accept messages from any thread."""
    infra: Any = import_module("viser.infra._infra")
    events = ("message_event", asyncio.Event, field(default_factory=AnyThreadEvent))
    infra.AsyncMessageBuffer = make_dataclass("AnyThreadBuffer", [events], bases=(infra.AsyncMessageBuffer,))
