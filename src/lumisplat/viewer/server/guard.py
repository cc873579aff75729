"""Controls access to the viewer (docs/adr/0043-viewer-token-and-message-checks.md); validates messages of pages.

Pages on this machine need the access token. Messages of an unknown type, of excessive length or with values that are
not finite are dropped and counted.
"""

from __future__ import annotations

import hmac
import http
import ipaddress
import logging
import math
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, cast
from urllib.parse import SplitResult, parse_qs, urlsplit

from lumisplat.viewer.thresholds import MESSAGE_BYTES_MAX, UPLOAD_BYTES_MAX

Refusal = tuple[http.HTTPStatus, str]
"""HTTP status and text of the answer to a refused request."""

LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
"""Host names that always refer to this machine."""


def is_loopback(host: str) -> bool:
    """True if only this machine can connect to a server that listens on the address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Guard:
    """Access control of the page server: decides for each HTTP request whether it is answered.

    ``Host`` must name this machine, which prevents DNS rebinding. ``Origin``, if a browser sends it, must be the page's
    own. The token must be in the address or, later, in a cookie that scripts cannot read and other sites do not send.
    """

    host: str
    """Address on which the server listens, such as ``127.0.0.1``."""
    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    """Random access token of this viewer; its holder can open any number of pages."""

    @property
    def url(self) -> str:
        """Address that opens the viewer, including the token."""
        shown = "127.0.0.1" if self.host in ("", "0.0.0.0", "::") else self.host.strip("[]")
        return f"http://{f'[{shown}]' if ':' in shown else shown}:{self.port}/?token={self.token}"

    @property
    def cookie(self) -> str:
        """Name of the access cookie; it contains the port, as browsers send a host's cookies to all of its ports."""
        return f"lumisplat-{self.port}"

    def refusal(self, path: str, headers: Mapping[str, str]) -> Refusal | None:
        """Returns status and text with which to refuse an HTTP request; None if the request is allowed.

        Args:
            path: Path and query of the request.
            headers: Headers of the request; lookup ignores case.
        """
        host = headers.get("Host", "")
        if is_loopback(self.host) and host.rsplit(":", 1)[0] not in (*LOOPBACK_NAMES, self.host):
            return http.HTTPStatus.FORBIDDEN, "Host: this viewer accepts requests from this machine only\n"
        origin = headers.get("Origin")
        if origin is not None and _split(origin).netloc != host:
            return http.HTTPStatus.FORBIDDEN, "Origin: pages of other sites are not allowed\n"
        if not (self._is_token(self.token_of(path)) or self._is_token(self._cookie_of(headers))):
            return http.HTTPStatus.UNAUTHORIZED, "token missing or wrong: open the address that the viewer printed\n"
        return None

    def token_of(self, path: str) -> str:
        """Returns the access token in the query of a request's path, valid or not; empty if there is none."""
        return parse_qs(_split(path).query).get("token", [""])[0]

    def set_cookie(self) -> str:
        """Returns a ``Set-Cookie`` header value with the token, so that later requests need no token in the address."""
        return f"{self.cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"

    def _cookie_of(self, headers: Mapping[str, str]) -> str:
        pairs = (part.strip().partition("=") for part in headers.get("Cookie", "").split(";"))
        return next((value for name, _, value in pairs if name == self.cookie), "")

    def _is_token(self, given: str) -> bool:
        """True if a text is the access token; compares in constant time, so that timing reveals nothing."""
        return hmac.compare_digest(given.encode(errors="replace"), self.token.encode())


def _split(address: str) -> SplitResult:
    """Splits a URL; the result has empty parts if the URL is invalid."""
    try:
        return urlsplit(address)
    except ValueError:
        return SplitResult("", "", "", "", "")


_log = logging.getLogger("lumisplat.pages")

_KINDS = frozenset(
    {
        "ViewerCameraMessage",
        "CameraStoppedMessage",
        "GuiUpdateMessage",
        "GuiFormSubmitMessage",
        "GuiFormDirtyMessage",
        "CommandTriggerMessage",
        "ScenePointerMessage",
        "TransformControlsUpdateMessage",
        "TransformControlsDragStartMessage",
        "TransformControlsDragEndMessage",
        "FileTransferStartUpload",
        "FileTransferPart",
        "FileTransferPartAck",
        "LocalStorageGetItemResponseMessage",
        "GetRenderResponseMessage",
    }
)
"""Message types that a page may send. Others are dropped, such as requests for a public share URL."""

_VECTORS = {
    "ViewerCameraMessage": {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3},
    "TransformControlsUpdateMessage": {"wxyz": 4, "position": 3},
}
"""Message fields that must be lists of finite numbers, with the required length, by message type."""

_NUMBERS = {"ViewerCameraMessage": ("fov", "near", "far", "image_height", "image_width")}
"""Message fields that must be finite numbers > 0, by message type."""


class Inbox:
    """Decides for each WebSocket message of one page whether it is valid; counts invalid ones."""

    def __init__(self) -> None:
        self._left: dict[str, int] = {}
        """Bytes of each announced upload that have not arrived yet, by upload id; parts that exceed them are invalid.
        """
        self.dropped = 0

    def accepts(self, raw: object) -> bool:
        """True if a message is valid, otherwise it must be dropped; the page's first invalid message is logged."""
        reason = self._fault(raw)
        if reason is None:
            return True
        self.dropped += 1
        if self.dropped == 1:
            _log.warning("invalid messages from a page are dropped; the first one: %s", reason)
        return False

    def _fault(self, raw: object) -> str | None:  # noqa: PLR0911
        """Returns the reason why a message is invalid; None if it is valid."""
        import msgspec

        if not isinstance(raw, bytes) or len(raw) > MESSAGE_BYTES_MAX:
            return "it is text or too long"
        try:
            message: object = msgspec.msgpack.decode(raw)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return "it cannot be decoded"
        if not isinstance(message, dict):
            return "it is not a table"
        fields = cast(dict[str, Any], message)
        kind = fields.get("type")
        if not isinstance(kind, str) or kind not in _KINDS:
            return f"its type is {str(kind)[:40]!r}"
        for name, count in _VECTORS.get(kind, {}).items():
            if not _is_vector(fields.get(name), count):
                return f"{name} of {kind} is not {count} finite numbers"
        for name in _NUMBERS.get(kind, ()):
            if not _is_number(fields.get(name)) or fields[name] <= 0:
                return f"{name} of {kind} is not a finite number > 0"
        if kind == "GuiUpdateMessage":
            updates = fields.get("updates")
            return None if isinstance(updates, dict) and updates.keys() == {"value"} else "it changes more than a value"
        if kind.startswith("FileTransfer") and (fault := self._upload_fault(kind, fields)) is not None:
            return fault
        return _fault_of_fields(raw)

    def _upload_fault(self, kind: str, fields: Mapping[str, Any]) -> str | None:
        """Returns why a message that announces or continues a file upload is invalid; None if it is valid."""
        transfer = fields.get("transfer_uuid")
        if not isinstance(transfer, str):
            return "an upload has no id"
        if kind == "FileTransferStartUpload":
            size, parts = fields.get("size_bytes"), fields.get("part_count")
            if not isinstance(size, int) or not 0 <= size <= UPLOAD_BYTES_MAX - sum(self._left.values()):
                return f"uploads exceed {UPLOAD_BYTES_MAX // 2**20} MB"
            if not isinstance(parts, int) or not 0 <= parts <= size:
                return "an upload has more parts than bytes"
            self._left[transfer] = size
        elif kind == "FileTransferPart":
            if transfer not in self._left:
                return "a part belongs to no upload"
            content = fields.get("content")
            if not isinstance(content, bytes) or len(content) > self._left[transfer]:
                return "an upload exceeds its declared size"
            self._left[transfer] -= len(content)
            if self._left[transfer] == 0:
                del self._left[transfer]
        return None


def _fault_of_fields(raw: bytes) -> str | None:
    """Decodes a message as viser does; returns the error, which would close the connection in viser, or None."""
    from viser import _messages

    try:
        _messages.Message.deserialize(raw)
    except Exception as error:  # the constructors raise errors of any type
        return f"its fields are invalid: {error}"
    return None


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_vector(value: object, count: int) -> bool:
    if not isinstance(value, list):
        return False
    numbers = cast(list[object], value)
    return len(numbers) == count and all(map(_is_number, numbers))


class FilteredConnection:
    """A WebSocket whose ``recv`` returns only messages that an `Inbox` accepts.

    Args:
        connection: The WebSocket.
        is_accepting: Returns True while the server handles messages.
    """

    def __init__(self, connection: Any, is_accepting: Callable[[], bool]) -> None:
        self._connection, self._is_heard, self._inbox = connection, is_accepting, Inbox()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> bytes:
        """Returns the next valid message."""
        while True:
            raw: bytes = await self._connection.recv()
            if self._is_heard() and self._inbox.accepts(raw):
                return raw
