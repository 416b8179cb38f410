"""The HTTP application: its routes, refusals and answers, and its one worker."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import time
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from importlib.resources import files

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from lidar2pano.bounded_files import read_bytes
from lidar2pano.demo import street
from lidar2pano.errors import InputError
from lidar2pano.recordings.reading_process import get_ready
from lidar2pano.serve.guards import HEADERS, Guard
from lidar2pano.serve.uploads import (
    FILES,
    PAGE,
    KeptResults,
    Limits,
    Query,
    Result,
    UploadTranslator,
    file_of_form,
    parse_query,
)

TYPES = {"rgb": "image/png", "segments": "image/png", "labels": "application/octet-stream", "depth": "image/png"} | {
    PAGE: "text/html"
}
DOUBTS = "Lidar2pano-Doubts"  # header
MOST_EXAMPLE_BYTES = 1 << 24
# Of a body that is too long: bytes taken and forgotten, seconds between its parts, digits of its length.
MOST_DRAINED, DRAIN_S, MOST_DIGITS = 1 << 30, 1.0, 19
CLOSED = 499  # for the metrics: the client went away


def create_application(translator: UploadTranslator, limits: Limits, hosts: list[str] | None = None) -> Starlette:
    """Return the application, with one worker of the same life.

    hosts  names allowed in the header Host, beside loopback addresses; None: any.
    """
    service = Service(translator, limits)

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        service.worker.submit(get_ready)  # in the thread that reads
        yield
        await asyncio.to_thread(service.worker.shutdown, cancel_futures=True)

    return Starlette(
        routes=[
            Route("/panorama", service.panorama, methods=["POST"]),
            Route("/results/{name}/{part}", service.result),
            Route("/example", service.example),
            Route("/health", service.health),
            Route("/metrics", service.metrics),
            Route("/openapi.json", partial(page, "openapi.json", "application/json")),
            Route("/docs", partial(page, "docs.html", "text/html")),
            Route("/", partial(page, "index.html", "text/html")),
        ],
        exception_handlers={HTTPException: refused, InputError: unusable, Exception: broken},  # pyright: ignore
        middleware=[Middleware(Guard, hosts=hosts)],
        lifespan=lifespan,
    )


class Measurements:
    """Counters of one server, with a registry of their own, as /metrics gives them: Prometheus' text format."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "lidar2pano_requests", "Requests for panoramas by HTTP status.", ["status"], registry=self.registry
        )
        self.waiting = Gauge(
            "lidar2pano_waiting", "Requests that are taken and not answered yet.", registry=self.registry
        )
        self.points = Counter("lidar2pano_points", "Points of translated scans.", registry=self.registry)
        self.stages = Histogram(
            "lidar2pano_stage_seconds", "Time of each stage of a panorama.", ["stage"], registry=self.registry
        )
        self.seconds = Histogram(
            "lidar2pano_request_seconds",
            "Time from a request to its answer.",
            buckets=(0.1, 0.25, 0.5, 1, 2.5, 5, 10, 25, 60, 120),
            registry=self.registry,
        )


class Service:
    """The handlers of requests for panoramas, and their common state."""

    def __init__(self, translator: UploadTranslator, limits: Limits) -> None:
        self.translator, self.limits = translator, limits
        self.worker = ThreadPoolExecutor(1, "panoramas")
        self.kept, self.measurements = KeptResults(limits), Measurements()
        self._taken = 0
        self._usual_seconds = 1.0  # of one panorama, a running mean

    async def panorama(self, request: Request) -> Response:
        """POST /panorama: take a place, read the body, wait for the worker, answer."""
        begin = time.monotonic()
        status = 500
        try:
            response = await self._admitted(request)
            status = response.status_code
            return response
        except HTTPException as error:
            status = error.status_code
            raise
        except InputError:
            status = 422
            raise
        finally:
            self.measurements.requests.labels(str(status)).inc()
            self.measurements.seconds.observe(time.monotonic() - begin)

    async def _admitted(self, request: Request) -> Response:
        query = parse_query(request.query_params)
        if self._taken >= self.limits.waiting:
            wait_s = math.ceil(self._taken * self._usual_seconds)
            raise HTTPException(429, "the queue is full; try again later", {"Retry-After": str(max(1, wait_s))})
        self._taken += 1
        self.measurements.waiting.set(self._taken)
        try:
            async with asyncio.timeout(self.limits.seconds):
                result = await self._translated(request, query)
        except TimeoutError:
            raise HTTPException(504, f"no answer within {self.limits.seconds:g} s; send less, or try again") from None
        except ClientDisconnect:
            raise HTTPException(CLOSED, "the client went away") from None
        finally:
            self._taken -= 1
            self.measurements.waiting.set(self._taken)
        return self._answer(result, query.answer)

    async def _translated(self, request: Request, query: Query) -> Result:
        try:
            async with asyncio.timeout(self.limits.upload_seconds):
                body = await self._body(request)
        except TimeoutError:
            raise HTTPException(408, f"no whole body within {self.limits.upload_seconds:g} s; try again") from None
        body, name = file_of_form(body, request.headers.get("content-type", ""))
        call = partial(self.translator, body, query.name or name, query.save, query.reading)
        waiting = asyncio.get_running_loop().run_in_executor(self.worker, call)
        gone = asyncio.ensure_future(_disconnected(request))
        try:
            await asyncio.wait({waiting, gone}, return_when=asyncio.FIRST_COMPLETED)
            if not waiting.done():
                raise ClientDisconnect
            result = waiting.result()
        finally:
            gone.cancel()
            waiting.cancel()  # never begun if it has not begun yet
        self._measure(result)
        return result

    async def _body(self, request: Request) -> bytes:
        most = self.limits.body_bytes
        too_long = HTTPException(413, f"the body is longer than {most} bytes; send a single scan")
        length = request.headers.get("content-length", "0")
        claimed = int(length) if length.isdecimal() and len(length) < MOST_DIGITS else 0
        if claimed > MOST_DRAINED or (claimed > most and "expect" in request.headers):
            raise too_long
        body, received, chunks = bytearray(), 0, aiter(request.stream())
        while (chunk := await _next_chunk(chunks, max(received, claimed) > most)) is not None:
            received += len(chunk)
            if max(received, claimed) <= most:
                body += chunk
            elif received > MOST_DRAINED:
                break
        if max(received, claimed) > most:
            raise too_long
        if not body:
            raise HTTPException(422, "the body is empty; send the bytes of a scan file")
        return bytes(body)

    def _measure(self, result: Result) -> None:
        self.measurements.points.inc(result.points)
        for stage, value in result.milliseconds.items():
            self.measurements.stages.labels(stage).observe(value / 1e3)
        self._usual_seconds += 0.2 * (sum(result.milliseconds.values()) / 1e3 - self._usual_seconds)

    def _answer(self, result: Result, answer: str) -> Response:
        if answer == "zip":
            return Response(result.zipped(), media_type="application/zip", headers=HEADERS | _doubts(result))
        if answer == "png":
            return Response(result.files["rgb"], media_type="image/png", headers=HEADERS | _doubts(result))
        name = self.kept.keep(result)
        content = {
            "points": result.points,
            "dropped": result.dropped,
            "milliseconds": result.milliseconds,
            "doubts": result.doubts,
            "weights": self.translator.weights,
            "outputs": {part: f"/results/{name}/{part}" for part in result.files},
            "seconds": self.limits.kept_seconds,
        }
        return JSONResponse(content, headers=HEADERS | _doubts(result))

    async def result(self, request: Request) -> Response:
        """GET /results/NAME/PART: an output linked by a JSON answer."""
        kept, part = self.kept.get(request.path_params["name"]), request.path_params["part"]
        if kept is None or part not in kept.files:
            raise HTTPException(404, "no such result, or no longer; send the scan again")
        disposition = {"Content-Disposition": f'inline; filename="{FILES[part]}"'}
        return Response(kept.files[part], media_type=TYPES[part], headers=HEADERS | disposition)

    async def example(self, request: Request) -> Response:
        """GET /example: the scan of the package, a KITTI .bin."""
        disposition = {"Content-Disposition": 'attachment; filename="example.bin"'}
        return Response(_example(), media_type="application/octet-stream", headers=HEADERS | disposition)

    async def health(self, request: Request) -> Response:
        """GET /health."""
        device, weights = str(self.translator.pipeline.device), self.translator.weights
        return JSONResponse(
            {"status": "ok", "weights": weights, "device": device, "waiting": self._taken}, headers=HEADERS
        )

    async def metrics(self, request: Request) -> Response:
        """GET /metrics."""
        text = generate_latest(self.measurements.registry)
        return Response(text, media_type="text/plain; version=0.0.4; charset=utf-8", headers=HEADERS)


def _doubts(result: Result) -> dict[str, str]:
    """Return the header with the doubts about a scan, a JSON array in ASCII; none without doubts."""
    return {DOUBTS: json.dumps(result.doubts)} if result.doubts else {}


async def _next_chunk(chunks: AsyncIterator[bytes], drained: bool) -> bytes | None:
    """Return the next part of a body; None at its end, or if it is only drained and the client waits.

    Most clients read no answer before they have sent everything.
    """
    try:
        async with asyncio.timeout(DRAIN_S if drained else None):
            return await anext(chunks, None)
    except TimeoutError:
        return None


async def _disconnected(request: Request) -> None:
    """Return when the client has gone away."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


@cache
def _example() -> bytes:
    return read_bytes(street(), MOST_EXAMPLE_BYTES)


@cache
def _page_text(name: str) -> str:
    return (files("lidar2pano.serve") / "pages" / name).read_text(encoding="utf-8")


async def page(name: str, media_type: str, request: Request) -> Response:
    """Answer with a page of the package; `name` is never the client's."""
    return Response(_page_text(name), media_type=media_type, headers=HEADERS)


async def refused(request: Request, error: HTTPException) -> Response:
    """Answer a refusal as JSON."""
    return JSONResponse({"error": error.detail}, error.status_code, headers=HEADERS | dict(error.headers or {}))


async def unusable(request: Request, error: InputError) -> Response:
    """Answer an unusable scan or option as JSON."""
    return JSONResponse({"error": str(error)}, 422, headers=HEADERS)


async def broken(request: Request, error: Exception) -> Response:
    """Answer a fault of the server: its log has the traceback, the client gets none of it."""
    return JSONResponse({"error": "the server failed; its log says why"}, 500, headers=HEADERS)
