"""What a server takes at most."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a server takes at most.

    body_bytes  of one request;  points: of one scan.
    waiting     requests that are taken and not answered yet; one more is refused with 429.
    seconds     from a request to its answer;  upload_seconds: until its body is there.
    kept        results that links point to; kept_seconds: for how long.
    """

    body_bytes: int = 64 << 20
    points: int = 2_000_000
    waiting: int = 8
    seconds: float = 120.0
    upload_seconds: float = 30.0
    kept: int = 16
    kept_seconds: float = 300.0
