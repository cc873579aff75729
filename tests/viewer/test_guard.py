"""Who may talk to the viewer: by the rules alone, and over a real port."""

from __future__ import annotations

import asyncio
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
from lumisplat.viewer.server.guard import Guard, Inbox, is_loopback
from lumisplat.viewer.server.page_server import AnyThreadEvent, PageServer, listening_socket
from lumisplat.viewer.thresholds import UPLOAD_BYTES_MAX

GUARD = Guard("127.0.0.1", 8080, token="a" * 32)
OWN = {"Host": "127.0.0.1:8080"}
WITH_TOKEN = f"/?token={GUARD.token}"


def status(guard: Guard, path: str, headers: dict[str, str]) -> int:
    """Status of an answer; 200: the request comes in."""
    refused = guard.refusal(path, headers)
    return 200 if refused is None else int(refused[0])


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "[::1]:8080", "127.0.0.1"])
def test_pages_of_this_machine_with_the_token_come_in(host: str) -> None:
    """By the address, or by the cookie that it has set; whatever other cookies there are."""
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
def test_others_do_not(path: str, headers: dict[str, str], expected: int) -> None:
    """No token: 401. A name that is not this machine's, or a page of another site, even with the token: 403."""
    assert status(GUARD, path, headers) == expected


def test_a_viewer_for_others_takes_any_name_but_never_another_origin() -> None:
    """Then names of this machine are not known; the token still is."""
    guard = Guard("0.0.0.0", 8080)
    assert not is_loopback("0.0.0.0") and not is_loopback("192.168.1.2") and is_loopback("::1")
    assert status(guard, f"/?token={guard.token}", {"Host": "desk.lan:8080"}) == 200
    assert status(guard, "/", {"Host": "desk.lan:8080"}) == 401
    other = {"Host": "desk.lan:8080", "Origin": "http://evil.example"}
    assert status(guard, f"/?token={guard.token}", other) == 403
    assert guard.url.startswith("http://127.0.0.1:8080/?token=")


@pytest.mark.parametrize("host", ["127.0.0.2", "::1", "[::1]"])
def test_the_printed_address_opens_the_viewer(host: str) -> None:
    """Whatever name of this machine it listens on."""
    guard = Guard(host, 8080)
    address = guard.url.removeprefix("http://")
    assert status(guard, f"/?token={guard.token}", {"Host": address.partition("/")[0]}) == 200
    assert "[[" not in address


def test_tokens_are_long_and_new() -> None:
    """Nobody guesses one, and that of another viewer does not help."""
    tokens = {Guard("127.0.0.1", 1).token for _ in range(50)}
    assert len(tokens) == 50 and min(map(len, tokens)) >= 32


# --- Over a real port ---


@pytest.fixture(scope="module")
def server() -> Iterator[PageServer]:
    """A server on a free port."""
    server = PageServer("127.0.0.1", 0)
    yield server
    server.close()


def get(server: PageServer, path: str, **headers: str) -> tuple[int, dict[str, str]]:
    """Status and headers of an answer."""
    request = urllib.request.Request(f"http://127.0.0.1:{server.guard.port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status, dict(answer.headers)
    except urllib.error.HTTPError as error:
        with error:
            return error.code, dict(error.headers)


def test_the_page_is_behind_the_guard(server: PageServer) -> None:
    """Every request asks it: this fails as soon as viser opens its port without."""
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
    """Status of the answer to a WebSocket; 101: it is open, and says something."""

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
    """The version that viser's own page speaks."""
    import viser

    return f"viser-v{viser.__version__}"


def test_the_web_socket_is_behind_the_guard(server: PageServer) -> None:
    """An evil page's socket gets 403, even with the token, and one without it 401."""
    own, token = f"http://127.0.0.1:{server.guard.port}", server.guard.token
    assert socket_status(server, origin=own, token=token) == 101
    assert socket_status(server, origin=None, token=token) == 101
    assert socket_status(server, origin="https://evil.example", token=token) == 403
    assert socket_status(server, origin=own, token="") == 401


def test_events_are_set_from_any_thread() -> None:
    """While others wait for it and go: asyncio's own raises then, and messages to pages, and edits, are lost."""
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


def test_the_server_of_pages_has_such_events(server: PageServer) -> None:
    """That of all pages; those of each page are made in the same way."""
    buffer: Any = server.viser
    assert isinstance(buffer._websock_server._broadcast_buffer.message_event, AnyThreadEvent)


def test_a_port_in_use_is_named() -> None:
    """With what to do; also one that is none."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ls.DeviceError, match=rf"port {port} of 127\.0\.0\.1 .*--port 0 takes a free one"):
            PageServer("127.0.0.1", port)
    with pytest.raises(ls.DeviceError, match="port 70000"):
        listening_socket("127.0.0.1", 70000)


def test_a_server_that_closes_leaves_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    """Its port is free again, its threads have ended, and it has printed nothing."""
    before = set(threading.enumerate())
    server = PageServer("127.0.0.1", 0)
    get(server, f"/?token={server.guard.token}")
    server.close()
    listening_socket("127.0.0.1", server.guard.port).close()
    for thread in set(threading.enumerate()) - before:
        thread.join(timeout=10)
        assert not thread.is_alive(), thread
    assert capfd.readouterr() == ("", "")


# --- What a page may say ---

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
    """Which of the messages of one page are passed on."""
    inbox = Inbox()
    return [inbox.accepts(msgspec.msgpack.encode(message)) for message in messages]


def test_messages_of_the_page_pass() -> None:
    """A camera, a changed value, and a file in parts."""
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
def test_nonsense_is_dropped_and_named_once(message: object, caplog: pytest.LogCaptureFixture) -> None:
    """Whatever it is; one line for a page, however much of it there is."""
    assert accepts(message, message, CAMERA) == [False, False, True]
    assert len(caplog.records) == 1


def test_bytes_that_are_no_message_are_dropped() -> None:
    """Text, noise, and what nests deeper than it can be read."""
    inbox = Inbox()
    for raw in ("text", b"", b"\xc1", b"\xff" * 100, b"\x91" * 5000, bytes(2**23)):
        assert not inbox.accepts(raw)
    assert inbox.dropped == 6


def test_uploads_bring_no_more_than_they_said() -> None:
    """Nor do several at once bring more than one may."""
    start, part = UPLOAD | {"size_bytes": 4, "part_count": 2}, PART | {"part_index": 0, "content": b"abc"}
    assert accepts(start, part, part) == [True, True, False]
    large = UPLOAD | {"size_bytes": UPLOAD_BYTES_MAX // 2 + 1, "part_count": 1}
    assert accepts(large | {"transfer_uuid": "a"}, large | {"transfer_uuid": "b"}) == [True, False]
