"""The first look at each request: its target, its host, the page that it comes from."""

from __future__ import annotations

import ipaddress
from collections.abc import Collection
from urllib.parse import urlsplit

from starlette.datastructures import MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send

HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'unsafe-inline';"
    " img-src 'self' blob: data:; connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none';"
    " frame-ancestors 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
OWN_SITE = ("", "same-origin", "none")  # of Sec-Fetch-Site; none: typed or a bookmark; "": no browser of today


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
        if foreign or (origin is not None and urlsplit(origin.lower()).netloc != hosts[0].lower()):
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
