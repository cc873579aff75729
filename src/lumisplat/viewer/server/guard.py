"""Who may talk to the viewer: pages of this machine that know its token (docs/adr/0043-who-may-open-the-viewer.md)."""

from __future__ import annotations

import hmac
import http
import ipaddress
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from urllib.parse import SplitResult, parse_qs, urlsplit

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
