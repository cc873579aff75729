"""Decides who may talk to the viewer (docs/adr/0043-viewer-token-and-message-checks.md), and validates what they send.

Pages of this machine may that know its token. Messages that are of no known kind, too long or not finite are dropped
and counted.
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
"""Status and text of an answer to who may not come in."""

LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
"""Names of this machine that never lead elsewhere."""


def is_loopback(host: str) -> bool:
    """Whether an address to listen on is reached from this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Guard:
    """Checks requests before anything else sees them.

    ``Host`` must be a name of this machine, against pages of others whose name is made to lead here; ``Origin``, where
    a browser sends it, must be the page's own; and the token must come with the address or, from then on, as a cookie
    that scripts cannot read and other sites' pages do not send.
    """

    host: str
    """Address to listen on."""
    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    """Made anew for each viewer; whoever has it may open any number of pages."""

    @property
    def url(self) -> str:
        """The address that opens the viewer, with the token."""
        shown = "127.0.0.1" if self.host in ("", "0.0.0.0", "::") else self.host.strip("[]")
        return f"http://{f'[{shown}]' if ':' in shown else shown}:{self.port}/?token={self.token}"

    @property
    def cookie(self) -> str:
        """Name of the cookie; browsers send one host's cookies to all of its ports."""
        return f"lumisplat-{self.port}"

    def refusal(self, path: str, headers: Mapping[str, str]) -> Refusal | None:
        """Why a request is refused; None: it may come in.

        Args:
            path: Path and query of the request.
            headers: Of the request, by any case of their names.
        """
        host = headers.get("Host", "")
        if is_loopback(self.host) and host.rsplit(":", 1)[0] not in (*LOOPBACK_NAMES, self.host):
            return http.HTTPStatus.FORBIDDEN, "Host: this viewer is open to this machine alone\n"
        origin = headers.get("Origin")
        if origin is not None and _split(origin).netloc != host:
            return http.HTTPStatus.FORBIDDEN, "Origin: a page of another site may not use this viewer\n"
        if not (self._is_token(self.token_of(path)) or self._is_token(self._cookie_of(headers))):
            return http.HTTPStatus.UNAUTHORIZED, "open the address with the token that the viewer has printed\n"
        return None

    def token_of(self, path: str) -> str:
        """The token in the query of a path; empty: there is none."""
        return parse_qs(_split(path).query).get("token", [""])[0]

    def set_cookie(self) -> str:
        """The value of ``Set-Cookie`` that lets a page come back without the token."""
        return f"{self.cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"

    def _cookie_of(self, headers: Mapping[str, str]) -> str:
        pairs = (part.strip().partition("=") for part in headers.get("Cookie", "").split(";"))
        return next((value for name, _, value in pairs if name == self.cookie), "")

    def _is_token(self, given: str) -> bool:
        """Compares in a time that does not depend on where they differ."""
        return hmac.compare_digest(given.encode(errors="replace"), self.token.encode())


def _split(address: str) -> SplitResult:
    """The parts of an address; of one that is none, empty ones."""
    try:
        return urlsplit(address)
    except ValueError:
        return SplitResult("", "", "", "", "")


_log = logging.getLogger("lumisplat.pages")

_KINDS = frozenset(
    {
        "ViewerCameraMessage",
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
"""Messages that pages send; others, such as requests to be shared with the world, are nobody's business here."""

_VECTORS = {
    "ViewerCameraMessage": {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3},
    "TransformControlsUpdateMessage": {"wxyz": 4, "position": 3},
}
"""Fields that are so many finite numbers."""

_NUMBERS = {"ViewerCameraMessage": ("fov", "near", "far", "image_height", "image_width")}
"""Fields that are finite numbers above 0."""


class Inbox:
    """Decides which messages of one page are passed on."""

    def __init__(self) -> None:
        self._left: dict[str, int] = {}
        """Bytes that each upload may still bring."""
        self.dropped = 0

    def accepts(self, raw: object) -> bool:
        """Whether a message is one that a page may send; the first that is not is logged."""
        reason = self._fault(raw)
        if reason is None:
            return True
        self.dropped += 1
        if self.dropped == 1:
            _log.warning("a page sent something that is no message of the viewer, which was dropped: %s", reason)
        return False

    def _fault(self, raw: object) -> str | None:  # noqa: PLR0911
        """What is wrong with a message; None: nothing."""
        import msgspec

        if not isinstance(raw, bytes) or len(raw) > MESSAGE_BYTES_MAX:
            return "it is text, or too long"
        try:
            message: object = msgspec.msgpack.decode(raw)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return "it cannot be decoded"
        if not isinstance(message, dict):
            return "it is no table"
        fields = cast(dict[str, Any], message)
        kind = fields.get("type")
        if not isinstance(kind, str) or kind not in _KINDS:
            return f"its type is {str(kind)[:40]!r}"
        for name, count in _VECTORS.get(kind, {}).items():
            if not _is_vector(fields.get(name), count):
                return f"{name} of {kind} is not {count} finite numbers"
        for name in _NUMBERS.get(kind, ()):
            if not _is_number(fields.get(name)) or fields[name] <= 0:
                return f"{name} of {kind} is no number above 0"
        if kind == "GuiUpdateMessage":
            updates = fields.get("updates")
            return None if isinstance(updates, dict) and updates.keys() == {"value"} else "it changes more than a value"
        if kind.startswith("FileTransfer") and (fault := self._upload_fault(kind, fields)) is not None:
            return fault
        return _fault_of_fields(raw)

    def _upload_fault(self, kind: str, fields: Mapping[str, Any]) -> str | None:
        """What is wrong with a part of an upload: it is larger than files may be, or than was said."""
        transfer = fields.get("transfer_uuid")
        if not isinstance(transfer, str):
            return "an upload has no name"
        if kind == "FileTransferStartUpload":
            size, parts = fields.get("size_bytes"), fields.get("part_count")
            if not isinstance(size, int) or not 0 <= size <= UPLOAD_BYTES_MAX - sum(self._left.values()):
                return f"uploads are larger than {UPLOAD_BYTES_MAX // 2**20} MB"
            if not isinstance(parts, int) or not 0 <= parts <= size:
                return "an upload has more parts than bytes"
            self._left[transfer] = size
        elif kind == "FileTransferPart":
            if transfer not in self._left:
                return "a part is of no upload"
            content = fields.get("content")
            if not isinstance(content, bytes) or len(content) > self._left[transfer]:
                return "an upload is larger than it said"
            self._left[transfer] -= len(content)
            if self._left[transfer] == 0:
                del self._left[transfer]
        return None


def _fault_of_fields(raw: bytes) -> str | None:
    """What viser itself would fail at, which would end the connection."""
    from viser import _messages

    try:
        _messages.Message.deserialize(raw)
    except Exception as error:  # whatever its many constructors raise
        return f"its fields are wrong: {error}"
    return None


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_vector(value: object, count: int) -> bool:
    if not isinstance(value, list):
        return False
    numbers = cast(list[object], value)
    return len(numbers) == count and all(map(_is_number, numbers))


class FilteredConnection:
    """A WebSocket whose ``recv`` gives only what an `Inbox` accepts; everything else is the socket's own.

    Args:
        connection: The WebSocket.
        is_heard: Whether the server still listens to pages.
    """

    def __init__(self, connection: Any, is_accepting: Callable[[], bool]) -> None:
        self._connection, self._is_heard, self._inbox = connection, is_accepting, Inbox()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> bytes:
        """The next message that is accepted."""
        while True:
            raw: bytes = await self._connection.recv()
            if self._is_heard() and self._inbox.accepts(raw):
                return raw
