"""The guard controls access and validates messages, directly and over a real port."""

from __future__ import annotations

import asyncio
import gc
import socket
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
import websockets

import lumisplat as ls
from lumisplat.viewer.server.event_queue import press_callback, value_callback
from lumisplat.viewer.server.guard import Guard, Inbox, is_loopback
from lumisplat.viewer.server.page_server import AnyThreadEvent, PageServer, listening_socket
from lumisplat.viewer.thresholds import UPLOAD_BYTES_MAX

GUARD = Guard("127.0.0.1", 8080, token="a" * 32)
OWN = {"Host": "127.0.0.1:8080"}
WITH_TOKEN = f"/?token={GUARD.token}"


def status(guard: Guard, path: str, headers: dict[str, str]) -> int:
    """Returns the status of the guard's answer; 200 if the request is allowed."""
    refused = guard.refusal(path, headers)
    return 200 if refused is None else int(refused[0])


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "[::1]:8080", "127.0.0.1"])
def test_guard_accepts_local_requests_with_token_or_cookie(host: str) -> None:
    """The token in the address or the viewer's cookie admits a request, among any other cookies."""
    assert status(GUARD, WITH_TOKEN, {"Host": host}) == 200
    cookie = GUARD.set_cookie().partition(";")[0]
    assert status(GUARD, "/", {"Host": host, "Cookie": f"a=b; {cookie}; c"}) == 200
    assert status(GUARD, "/", {"Host": host, "Origin": f"http://{host}", "Cookie": cookie}) == 200


@pytest.mark.parametrize(
    ("path", "headers", "expected"),
    [
        ("/", OWN, 401),
        ("/?token=", OWN, 401),
        ("/?token=wrong", OWN, 401),
        ("/?token=ä", OWN, 401),
        ("/", OWN | {"Cookie": "lumisplat-8080="}, 401),
        ("/", OWN | {"Cookie": f"lumisplat-8081={GUARD.token}"}, 401),
        (WITH_TOKEN, {"Host": "evil.example:8080"}, 403),
        (WITH_TOKEN, {"Host": "127.0.0.1.evil.example:8080"}, 403),
        (WITH_TOKEN, {}, 403),
        (WITH_TOKEN, OWN | {"Origin": "https://evil.example"}, 403),
        (WITH_TOKEN, OWN | {"Origin": "http://127.0.0.1:9999"}, 403),
        (WITH_TOKEN, OWN | {"Origin": "null"}, 403),
        (WITH_TOKEN, OWN | {"Origin": "http://["}, 403),
        ("//[", OWN, 401),
        ("/", OWN | {"Cookie": "lumisplat-8080=\udcff"}, 401),
    ],
)
def test_guard_rejects_requests_without_token_and_those_of_a_foreign_host_or_origin(
    path: str, headers: dict[str, str], expected: int
) -> None:
    """A missing token gives 401. A foreign host name or origin gives 403, even with the token."""
    assert status(GUARD, path, headers) == expected


def test_viewer_on_a_public_address_accepts_any_host_name_but_no_foreign_origin() -> None:
    """On a public address any ``Host`` is accepted, but the token stays required."""
    guard = Guard("0.0.0.0", 8080)
    assert not is_loopback("0.0.0.0") and not is_loopback("192.168.1.2") and is_loopback("::1")
    assert status(guard, f"/?token={guard.token}", {"Host": "desk.lan:8080"}) == 200
    assert status(guard, "/", {"Host": "desk.lan:8080"}) == 401
    other = {"Host": "desk.lan:8080", "Origin": "http://evil.example"}
    assert status(guard, f"/?token={guard.token}", other) == 403
    assert guard.url.startswith("http://127.0.0.1:8080/?token=")


@pytest.mark.parametrize("host", ["127.0.0.2", "::1", "[::1]"])
def test_printed_address_of_the_viewer_passes_its_guard(host: str) -> None:
    """The printed address works for each loopback address to listen on."""
    guard = Guard(host, 8080)
    address = guard.url.removeprefix("http://")
    assert status(guard, f"/?token={guard.token}", {"Host": address.partition("/")[0]}) == 200
    assert "[[" not in address


def test_viewer_tokens_are_long_and_unique() -> None:
    """A token cannot be guessed, and tokens of other viewers do not work."""
    tokens = {Guard("127.0.0.1", 1).token for _ in range(50)}
    assert len(tokens) == 50 and min(map(len, tokens)) >= 32


# --- Over a real port ---


@pytest.fixture(scope="module")
def server() -> Iterator[PageServer]:
    """Starts a page server on a free port."""
    server = PageServer("127.0.0.1", 0)
    yield server
    server.close()


def get(server: PageServer, path: str, **headers: str) -> tuple[int, dict[str, str]]:
    """Returns status and headers of a response."""
    request = urllib.request.Request(f"http://127.0.0.1:{server.guard.port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status, dict(answer.headers)
    except urllib.error.HTTPError as error:
        with error:
            return error.code, dict(error.headers)


def test_every_http_request_to_the_viewer_is_checked_by_the_guard(server: PageServer) -> None:
    """The test fails if a new version of viser opens its port without the guard."""
    with_token = f"/?token={server.guard.token}"
    found, headers = get(server, with_token)
    assert found == 200
    assert headers["Set-Cookie"] == server.guard.set_cookie() and "HttpOnly; SameSite=Strict" in headers["Set-Cookie"]
    cookie = headers["Set-Cookie"].partition(";")[0]
    assert get(server, "/", Cookie=cookie)[0] == 200
    assert get(server, "/")[0] == 401
    assert get(server, "/assets/anything.js")[0] == 401
    assert get(server, with_token, Host="evil.example")[0] == 403
    assert get(server, with_token, Origin="https://evil.example")[0] == 403
    assert get(server, f"/..%2f..%2f__init__.py{with_token[1:]}")[0] == 404
    assert "token" not in str(get(server, "/")[1])


def socket_status(server: PageServer, *, origin: str | None, token: str) -> int:
    """Returns the status of a WebSocket handshake; 101 if it is open and sends data."""

    async def attempt() -> int:
        address = f"ws://127.0.0.1:{server.guard.port}/?token={token}"
        try:
            async with websockets.connect(address, origin=origin, subprotocols=[subprotocol()]) as connection:  # pyright: ignore
                await asyncio.wait_for(connection.recv(), 10)
                return 101
        except websockets.exceptions.InvalidStatus as error:
            return error.response.status_code

    return asyncio.run(attempt())


def subprotocol() -> str:
    """Returns the subprotocol of viser's own page."""
    import viser

    return f"viser-v{viser.__version__}"


def test_every_web_socket_of_the_viewer_is_checked_by_the_guard(server: PageServer) -> None:
    """A socket of another site gets 403 even with the token; a socket without the token gets 401."""
    own, token = f"http://127.0.0.1:{server.guard.port}", server.guard.token
    assert socket_status(server, origin=own, token=token) == 101
    assert socket_status(server, origin=None, token=token) == 101
    assert socket_status(server, origin="https://evil.example", token=token) == 403
    assert socket_status(server, origin=own, token="") == 401


def test_setting_an_event_from_any_thread_raises_no_error_while_tasks_start_and_stop_waiting() -> None:
    """Setting an event while waiters come and go does not raise, as asyncio's own event would."""
    event, ends, woken = AnyThreadEvent(), threading.Event(), [0]
    errors: list[BaseException] = []

    async def wait() -> None:
        while not ends.is_set():
            waiters = [asyncio.ensure_future(event.wait()) for _ in range(50)]
            await asyncio.sleep(0)
            waiters[0].cancel()
            await asyncio.wait(waiters, timeout=60.0)
            woken[0] += sum(task.done() and not task.cancelled() for task in waiters)
            event.clear()

    def push(loop: asyncio.AbstractEventLoop) -> None:
        try:
            for _ in range(3000):
                event.set()
                loop.call_soon_threadsafe(event.set)
        except RuntimeError as error:
            errors.append(error)

    async def run() -> None:
        waiting = asyncio.ensure_future(wait())
        await asyncio.gather(*(asyncio.to_thread(push, asyncio.get_running_loop()) for _ in range(2)))
        ends.set()
        event.set()
        await waiting

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        asyncio.run(run())
    finally:
        sys.setswitchinterval(before)
    assert errors == [] and woken[0] >= 49


def test_message_buffers_of_the_page_server_use_thread_safe_events(server: PageServer) -> None:
    """The message buffer of the server has thread-safe events; buffers of pages are created in the same way."""
    buffer: Any = server.viser
    assert isinstance(buffer._websock_server._broadcast_buffer.message_event, AnyThreadEvent)


def test_page_server_reports_an_occupied_or_invalid_port() -> None:
    """The error names the port and what to do."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ls.DeviceError, match=rf"port {port} of 127\.0\.0\.1 .*--port 0 uses a free port"):
            PageServer("127.0.0.1", port)
    with pytest.raises(ls.DeviceError, match="port is 70000"):
        listening_socket("127.0.0.1", 70000)


def test_closed_page_server_frees_its_port_and_threads(capfd: pytest.CaptureFixture[str]) -> None:
    """Starting and closing the server prints nothing."""
    before = set(threading.enumerate())
    server = PageServer("127.0.0.1", 0)
    get(server, f"/?token={server.guard.token}")
    server.close()
    listening_socket("127.0.0.1", server.guard.port).close()
    for thread in set(threading.enumerate()) - before:
        thread.join(timeout=10)
        assert not thread.is_alive(), thread
    assert capfd.readouterr() == ("", "")


def test_closing_server_finishes_the_event_that_it_handles() -> None:
    """The event sets a control, whose callback viser runs in its loop; a stopped loop would never await it."""
    server = PageServer("127.0.0.1", 0)
    control = server.viser.gui.add_number("number", 0)
    control.on_update(value_callback(int, print))
    started, may_finish = threading.Event(), threading.Event()

    def set_control(_: object) -> None:
        started.set()
        may_finish.wait()
        control.value = 1

    asyncio.run_coroutine_threadsafe(press_callback(set_control)(object()), server.viser.get_event_loop())
    started.wait()
    threading.Timer(0.3, may_finish.set).start()
    server.close()
    assert control.value == 1
    gc.collect()


def test_event_may_close_the_server_that_handles_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The server does not wait for ever for the event to finish, which waits for the server to close."""
    monkeypatch.setattr("lumisplat.viewer.server.page_server.CLOSE_S", 0.1)
    server = PageServer("127.0.0.1", 0)
    closed = threading.Event()

    def close(_: object) -> None:
        server.close()
        closed.set()

    asyncio.run_coroutine_threadsafe(press_callback(close)(object()), server.viser.get_event_loop())
    assert closed.wait(timeout=20.0)


# --- Messages from pages ---

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0.0, 0.0, -4.0],
    "fov": 0.8,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 360,
    "image_width": 640,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, -1.0, 0.0],
}


UPLOAD = {
    "type": "FileTransferStartUpload",
    "source_component_uuid": "u",
    "transfer_uuid": "a",
    "filename": "a.ply",
    "mime_type": "",
}
PART = {"type": "FileTransferPart", "source_component_uuid": "u", "transfer_uuid": "a"}


def accepts(*messages: object) -> list[bool]:
    """Returns for each message of one page whether it is accepted."""
    inbox = Inbox()
    return [inbox.accepts(msgspec.msgpack.encode(message)) for message in messages]


def test_valid_messages_of_viewer_pages_are_accepted() -> None:
    """The messages are a camera, a changed control value and an uploaded file in parts."""
    start = UPLOAD | {"size_bytes": 5, "part_count": 2}
    parts = [PART | {"part_index": number, "content": content} for number, content in enumerate((b"abc", b"de"))]
    changed = {"type": "GuiUpdateMessage", "uuid": "u", "updates": {"value": 3}}
    assert accepts(CAMERA, changed, start, *parts) == [True] * 5


@pytest.mark.parametrize(
    "message",
    [
        CAMERA | {"position": [0.0, 0.0]},
        CAMERA | {"position": [0.0, float("nan"), 0.0]},
        CAMERA | {"wxyz": "1000"},
        CAMERA | {"fov": float("inf")},
        CAMERA | {"image_height": 0},
        {"type": "ShareUrlRequest"},
        {"type": "RunJavascriptMessage", "source": "alert(1)"},
        {"type": 7},
        {},
        [1, 2],
        "text",
        {"type": "GuiUpdateMessage", "uuid": "u", "updates": {"update_cb": []}},
        {"type": "GuiUpdateMessage", "uuid": "u", "updates": None},
        {"type": "FileTransferStartUpload", "transfer_uuid": "a", "size_bytes": UPLOAD_BYTES_MAX + 1, "part_count": 1},
        {"type": "FileTransferStartUpload", "transfer_uuid": "a", "size_bytes": 5, "part_count": 10**9},
        {"type": "FileTransferPart", "transfer_uuid": "a", "content": b"never announced"},
        {"type": "ScenePointerMessage", "screen_pos": []},
    ],
)
def test_invalid_messages_of_viewer_pages_are_dropped_and_logged_once(
    message: object, caplog: pytest.LogCaptureFixture
) -> None:
    """The log has one line per page, whatever the number of invalid messages."""
    assert accepts(message, message, CAMERA) == [False, False, True]
    assert len(caplog.records) == 1


def test_messages_of_viewer_pages_that_cannot_be_decoded_are_dropped() -> None:
    """Text, random bytes and messages nested too deeply are dropped."""
    inbox = Inbox()
    for raw in ("text", b"", b"\xc1", b"\xff" * 100, b"\x91" * 5000, bytes(2**23)):
        assert not inbox.accepts(raw)
    assert inbox.dropped == 6


def test_uploads_of_a_viewer_page_cannot_exceed_their_declared_size() -> None:
    """Several concurrent uploads together cannot exceed the limit of one."""
    start, part = UPLOAD | {"size_bytes": 4, "part_count": 2}, PART | {"part_index": 0, "content": b"abc"}
    assert accepts(start, part, part) == [True, True, False]
    large = UPLOAD | {"size_bytes": UPLOAD_BYTES_MAX // 2 + 1, "part_count": 1}
    assert accepts(large | {"transfer_uuid": "a"}, large | {"transfer_uuid": "b"}) == [True, False]
