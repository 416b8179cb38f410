"""Requests to the service as a target: method, path, query, headers and body, as a web server hands them on.

The text form of a request is that of HTTP: METHOD PATH?QUERY, headers, an empty line, the body.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, MutableMapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from lidar2pano.memory import Memory
from lidar2pano.panorama import Panorama
from lidar2pano.scan import Scan
from lidar2pano.serve import Limits, UploadTranslator, create_application
from random_weights import street, write_scan
from stand_in_pipeline import StandIn

ANSWERS = {200, 206, 307, 400, 404, 405, 408, 413, 416, 422, 429}  # never 500
HEADS = [
    "POST /panorama?as=json&save=rgb,page HTTP/1.1\nhost: localhost\ncontent-length: 800\nx-name: a.bin",
    "POST /panorama?name=a.csv.gz&as=zip&save=all HTTP/1.1\nhost: localhost\ncontent-type: text/csv",
    "POST /panorama HTTP/1.1\nhost: 127.0.0.1\naccept: image/png\nexpect: 100-continue",
    "GET /results/0123456789abcdef/rgb HTTP/1.1\nhost: localhost\nrange: bytes=0-9",
    "POST /panorama?forward=y&remission=255&sensor-height=1.9&strict=true HTTP/1.1\nhost: localhost",
    "POST /panorama HTTP/1.1\nhost: localhost\ncontent-type: multipart/form-data; boundary=x",
    "GET /health HTTP/1.1\nhost: localhost",
    "GET /metrics HTTP/1.1\nhost: localhost:8000\nx-forwarded-for: 1.2.3.4",
    "HEAD /docs HTTP/1.1\nhost: localhost\nif-none-match: x",
    "GET /openapi.json HTTP/1.1\nhost: localhost",
]


class Blank(StandIn):
    """A pipeline that takes every scan."""

    def step(self, memory: Memory, scan: Scan, *arguments: Any) -> tuple[Memory, Panorama]:
        """See Pipeline; the scan's points do not matter."""
        blank = Scan(xyz=np.zeros_like(scan.xyz), remission=scan.remission, name=scan.name)
        return super().step(memory, blank, *arguments)


def request_run(folder: Path) -> tuple[list[bytes], Callable[[bytes], object]]:
    """Good requests, and the function that sends one and checks that it gets a whole answer which is no fault's."""
    body = write_scan(folder / "request.bin", street(50)).read_bytes()
    limits = Limits(body_bytes=4000)
    translator = UploadTranslator(pipeline=Blank(), weights="stand-in", most_points=200)  # pyright: ignore
    application = create_application(translator, limits, ["127.0.0.1", "localhost"])
    loop = asyncio.new_event_loop()

    def run(data: bytes) -> None:
        scope, content = parsed(data)
        status, answer = loop.run_until_complete(answered(application, scope, content))
        assert status in ANSWERS, f"status {status}"
        if status != 200 and scope["method"] != "HEAD" and answer.startswith(b"{"):
            assert "\n" not in json.loads(answer)["error"]

    return [f"{head}\n\n".encode() + (body if head.startswith("POST") else b"") for head in HEADS], run


def parsed(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The ASGI scope of a request, and its body."""
    head, _, body = data.partition(b"\n\n")
    first, *lines = head.split(b"\n")
    method, _, target = first.partition(b" ")
    raw_path, _, query = target.partition(b" HTTP")[0].partition(b"?")
    headers = [(name.strip().lower(), value.strip()) for name, _, value in (line.partition(b":") for line in lines)]
    scope = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": method.decode("latin-1").upper(),
        "scheme": "http",
        "path": unquote(raw_path.decode("latin-1")),
        "raw_path": raw_path,
        "root_path": "",
        "query_string": query,
        "headers": headers,
        "client": ("127.0.0.1", 5),
        "server": ("127.0.0.1", 8000),
        "state": {},
    }
    return scope, body


async def answered(application: Any, scope: dict[str, Any], body: bytes) -> tuple[int, bytes]:
    """Status and body of the answer; the request's body comes in two pieces."""
    half = len(body) // 2
    waiting = [
        {"type": "http.request", "body": body[:half], "more_body": True},
        {"type": "http.request", "body": body[half:], "more_body": False},
    ]
    sent: list[MutableMapping[str, Any]] = []

    async def receive() -> MutableMapping[str, Any]:
        if waiting:
            return waiting.pop(0)
        await asyncio.Event().wait()
        raise AssertionError

    async def send(message: MutableMapping[str, Any]) -> None:
        sent.append(message)

    await application(scope, receive, send)
    return sent[0]["status"], b"".join(message.get("body", b"") for message in sent[1:])
