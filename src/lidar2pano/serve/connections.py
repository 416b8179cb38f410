"""Connections of clients: those that say nothing are closed after a time, and first when there are too many."""

from __future__ import annotations

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

SILENT_S = 10.0  # from a connection, or a request's first byte, to the end of its head
MOST_CONNECTIONS = 256


class BoundedConnection(H11Protocol):
    """A connection that is closed unless a whole request's head comes in time.

    Uvicorn limits the time between two requests alone.
    """

    silent_s, most_connections = SILENT_S, MOST_CONNECTIONS
    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:  # noqa: ANN401
        """Begin to wait; close the connection that is silent longest if there are too many."""
        super().connection_made(transport)
        self._watch()
        silent = [one for one in self.connections if isinstance(one, BoundedConnection) and one._deadline is not None]
        if len(self.connections) > self.most_connections and silent:
            min(silent, key=lambda one: one._deadline.when() if one._deadline else 0).transport.abort()

    def data_received(self, data: bytes) -> None:
        """Take bytes; those of a head do not prolong its time."""
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """Wait for the rest of a request that is answered already."""
        super().on_response_complete()
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no more."""
        super().connection_lost(exc)
        self._stop()

    def _watch(self) -> None:
        theirs, ours = self.conn.their_state, self.conn.our_state
        unfinished = theirs is h11.IDLE or (theirs is h11.SEND_BODY and ours in (h11.DONE, h11.MUST_CLOSE))
        if not unfinished:
            self._stop()
        elif self._deadline is None:
            self._deadline = self.loop.call_later(self.silent_s, self.transport.abort)

    def _stop(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None
