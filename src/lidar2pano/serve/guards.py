"""Guards of the service: connections that say nothing are closed; requests from elsewhere are refused."""

from __future__ import annotations

import asyncio
import ipaddress
from collections.abc import Collection
from typing import Any
from urllib.parse import urlsplit

import h11
from starlette.datastructures import MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'unsafe-inline';"
    " img-src 'self' blob: data:; connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none';"
    " frame-ancestors 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
OWN_SITE = ("", "same-origin", "none")  # of Sec-Fetch-Site; none: typed or a bookmark; "": no browser of today

SILENT_S = 10.0  # from a connection, or a request's first byte, to the end of its head
LEAST_READ_BYTES = 10_000  # of an answer in that time: 1 kB/s
MOST_CONNECTIONS = 256


class Guard:
    """Refuses requests to other hosts (400) and from pages of other origins (403).

    hosts  names allowed in the header Host, beside addresses of this machine alone; None: any.
    """

    def __init__(self, app: ASGIApp, hosts: Collection[str] | None) -> None:
        self.app, self._hosts = app, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer it."""
        if scope["type"] == "http":
            headers = MutableHeaders(scope=scope)
            _to_origin_form(scope, headers)
            if (refusal := self._refusal(scope["method"], headers)) is not None:
                await refusal(scope, receive, send)
                return
        await self.app(scope, receive, send)

    def _refusal(self, method: str, headers: MutableHeaders) -> JSONResponse | None:
        hosts = headers.getlist("host")
        if len(hosts) != 1 or (self._hosts is not None and not self._allows(hosts[0])):
            return JSONResponse({"error": "the request is for another host"}, 400, HEADERS)
        origin, site = headers.get("origin"), headers.get("sec-fetch-site", "").lower()
        link = method == "GET" and headers.get("sec-fetch-mode", "").lower() == "navigate" and origin is None
        foreign = site not in OWN_SITE and not link  # whoever follows a link sees the answer, not the other page
        if foreign or (origin is not None and origin.lower().partition("://")[2] != hosts[0].lower()):
            return JSONResponse(
                {"error": "the request comes from another site's page; use this server's own"}, 403, HEADERS
            )
        return None

    def _allows(self, host: str) -> bool:
        """Return whether a Host is one of the names, or an address that is this machine's for everybody."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        return name in (self._hosts or ()) or is_loopback(name)


def is_loopback(name: str) -> bool:
    """Return whether a text is an address of the loopback network: 127.0.0.0/8, ::1, also as ::ffff:127.0.0.1."""
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return False
    return (getattr(address, "ipv4_mapped", None) or address).is_loopback


def _to_origin_form(scope: Scope, headers: MutableHeaders) -> None:
    """Turn a target http://HOST/PATH into /PATH of that host (RFC 9112, 3.2.2)."""
    for scheme in ("http://", "https://"):
        if scope["path"].lower().startswith(scheme):
            host, slash, rest = scope["path"][len(scheme) :].partition("/")
            scope["path"], scope["raw_path"] = slash + rest or "/", None
            headers["host"] = host


class BoundedConnection(H11Protocol):
    """A connection that is closed unless a whole request's head comes in time, and the answer is read.

    Uvicorn limits the time between two requests alone. Answers lie in the transport until the client takes them.
    """

    silent_s, most_connections = SILENT_S, MOST_CONNECTIONS
    _deadline: asyncio.TimerHandle | None = None
    _unread = 0  # bytes of answers, when the deadline was set

    def connection_made(self, transport: Any) -> None:  # noqa: ANN401
        """Begin to wait; close the connection that is silent longest if there are too many."""
        super().connection_made(transport)
        self._watch()
        silent = [one for one in self.connections if isinstance(one, BoundedConnection) and one._deadline is not None]
        if len(self.connections) > self.most_connections and silent:
            oldest = min(silent, key=lambda one: one._deadline.when() if one._deadline else 0)
            oldest._stop()  # or the next of several that come at once would find it again
            oldest.transport.abort()

    def data_received(self, data: bytes) -> None:
        """Take bytes; those of a head do not prolong its time."""
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """Wait for the rest of a request that is answered already."""
        super().on_response_complete()
        self._watch()

    def pause_writing(self) -> None:
        """Wait for the client to read."""
        super().pause_writing()
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no more."""
        super().connection_lost(exc)
        self._stop()

    def _watch(self) -> None:
        if not self._is_waiting():
            self._stop()
        elif self._deadline is None:
            self._unread = self.transport.get_write_buffer_size()
            self._deadline = self.loop.call_later(self.silent_s, self._expire)

    def _is_waiting(self) -> bool:
        """Return whether it is the client's turn: to send a head or the rest of a body, or to read."""
        theirs, ours = self.conn.their_state, self.conn.our_state
        unfinished = theirs is h11.IDLE or (theirs is h11.SEND_BODY and ours in (h11.DONE, h11.MUST_CLOSE))
        return unfinished or self.transport.get_write_buffer_size() > 0

    def _expire(self) -> None:
        """Close the connection unless its client reads."""
        self._deadline = None
        unread = self.transport.get_write_buffer_size()
        if self._unread and unread <= max(self._unread - LEAST_READ_BYTES, 0):
            self._watch()
        elif self._is_waiting():
            self.transport.abort()

    def _stop(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None
