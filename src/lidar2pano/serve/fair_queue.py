"""A queue with one worker thread for its clients in turn."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any


class FairQueue:
    """Calls waiting for one thread. Clients take turns; the calls of one client keep their order.

    A call cancelled before its start is never made.
    """

    def __init__(self) -> None:
        self._waiting: OrderedDict[str, deque[tuple[Future[Any], Callable[[], Any]]]] = OrderedDict()
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="panoramas", daemon=True)
        self._thread.start()

    def submit(self, client: str, call: Callable[[], Any]) -> Future[Any]:
        """Enter a call and return the future of its result or exception. Raises RuntimeError after `close`."""
        future: Future[Any] = Future()
        with self._changed:
            if self._closed:
                raise RuntimeError("the queue is closed")
            self._waiting.setdefault(client, deque()).append((future, call))
            self._changed.notify()
        return future

    def close(self) -> None:
        """Take no more calls, finish the waiting ones, and end the thread."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _next(self) -> tuple[Future[Any], Callable[[], Any]] | None:
        """Return the first call of the next client, and put the client behind all others; None at the end."""
        with self._changed:
            while not self._waiting and not self._closed:
                self._changed.wait()
            if not self._waiting:
                return None
            client, calls = self._waiting.popitem(last=False)
            first = calls.popleft()
            if calls:
                self._waiting[client] = calls
            return first

    def _work(self) -> None:
        while (waiting := self._next()) is not None:
            future, call = waiting
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(call())
            except BaseException as error:  # any error is the caller's
                future.set_exception(error)
