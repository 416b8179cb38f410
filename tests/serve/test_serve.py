"""The HTTP service on a socket of this machine, with a pipeline that is fast."""

from __future__ import annotations

import asyncio
import base64
import gzip
import http.client
import importlib
import io
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any
from unittest import mock

import numpy as np
import pytest
import uvicorn
from PIL import Image
from uvicorn.server import ServerState

from house_rules import ROOT
from lidar2pano.cli import main
from lidar2pano.demo import street as demo_street
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import read
from lidar2pano.hardware import Timer
from lidar2pano.memory import Memory
from lidar2pano.serve import BoundedConnection, Limits, UploadTranslator, create_application, is_loopback
from lidar2pano.serve.uploads import KeptResults, Result, file_of_form, known_ending, parse_parts
from random_weights import street, write_scan
from stand_in_pipeline import StandIn


class Server:
    """A running server; `ask` gives status, headers and body."""

    def __init__(self, server: uvicorn.Server, thread: threading.Thread, port: int) -> None:
        self.server, self.thread, self.port = server, thread, port

    def ask(self, method: str, path: str, body: bytes | None = None, **headers: str) -> tuple[int, dict, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        connection.request(method, path, body, headers)
        answer = connection.getresponse()
        data = answer.read()
        connection.close()
        return answer.status, {name.lower(): value for name, value in answer.getheaders()}, data

    def sent(self, body: bytes) -> socket.socket:
        """A connection on which a scan has been sent and whose answer is not read yet."""
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=20)
        head = f"POST /panorama HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(body)}\r\n\r\n"
        connection.sendall(head.encode() + body)
        return connection

    def waiting(self) -> int:
        return json.loads(self.ask("GET", "/health")[2])["waiting"]


@contextmanager
def serving(
    pipeline: StandIn = StandIn(),  # noqa: B008
    points: int = 1000,
    connection: type[BoundedConnection] = BoundedConnection,
    application: Any = None,
    **limits,
) -> Iterator[Server]:
    translator = UploadTranslator(pipeline=pipeline, weights="stand-in", most_points=points)
    application = application or create_application(translator, Limits(**limits), ["localhost"])
    listening = socket.socket()
    listening.bind(("127.0.0.1", 0))
    server = uvicorn.Server(uvicorn.Config(application, log_level="critical", server_header=False, http=connection))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    while not server.started:
        time.sleep(0.005)
    try:
        yield Server(server, thread, listening.getsockname()[1])
    finally:
        server.should_exit = True
        thread.join(20)
        assert not thread.is_alive()


@pytest.fixture(scope="module")
def server():
    with serving() as running:
        yield running


@pytest.fixture
def scan(tmp_path):
    """The bytes of a scan file, and the colours of its panorama."""
    path = write_scan(tmp_path / "a.bin", street(60))
    timer = Timer(StandIn().device)
    pipeline = StandIn()
    _, panorama = pipeline.step(Memory(), read(path), None, timer)
    return path.read_bytes(), panorama.colour


def pixels(data: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(data)) as image:
        return np.array(image)


# --- answers ----------------------------------------------------------------------------------------------------------


def test_a_scan_becomes_a_png(server, scan):
    status, headers, data = server.ask("POST", "/panorama", scan[0])
    assert (status, headers["content-type"]) == (200, "image/png")
    assert np.array_equal(pixels(data), scan[1])


def test_a_zip_holds_everything(server, scan):
    status, headers, data = server.ask("POST", "/panorama?as=zip&save=all", scan[0])
    assert (status, headers["content-type"]) == (200, "application/zip")
    archive = zipfile.ZipFile(io.BytesIO(data))
    names = ["panorama.png", "panorama.segments.png", "panorama.label", "panorama.depth.png"]
    assert archive.namelist() == names and archive.testzip() is None
    assert np.array_equal(pixels(archive.read("panorama.png")), scan[1])
    assert len(archive.read("panorama.label")) == 4 * 60


def test_json_links_to_the_outputs(server, scan):
    status, _, data = server.ask("POST", "/panorama?as=json&save=rgb,depth", scan[0])
    answer = json.loads(data)
    assert status == 200 and answer["points"] == 60 and answer["weights"] == "stand-in"
    assert list(answer["outputs"]) == ["rgb", "depth"] and answer["milliseconds"]["paint"] >= 0
    assert np.array_equal(pixels(server.ask("GET", answer["outputs"]["rgb"])[2]), scan[1])
    status, headers, data = server.ask("GET", answer["outputs"]["depth"])
    assert status == 200 and headers["content-disposition"] == 'inline; filename="panorama.depth.png"'
    assert pixels(data).dtype == np.uint16
    assert server.ask("GET", answer["outputs"]["rgb"].replace("rgb", "labels"))[0] == 404


def test_a_page_to_look_around_in(server, scan):
    status, _, data = server.ask("POST", "/panorama?as=json&save=page", scan[0])
    link = json.loads(data)["outputs"]["page"]
    status, headers, page = server.ask("GET", link)
    assert status == 200 and headers["content-type"].startswith("text/html")
    assert b"<title>panorama" in page and b"Content-Security-Policy" in page


def test_any_known_format_by_its_content(server, tmp_path, scan):
    xyz = street(60).xyz
    text = "x,y,z,intensity\n" + "\n".join(f"{x},{y},{z},0.5" for x, y, z in xyz.tolist())
    np.save(tmp_path / "a.npy", np.column_stack([xyz, np.full(60, 0.5, np.float32)]))
    for body in (text.encode(), (tmp_path / "a.npy").read_bytes()):
        assert server.ask("POST", "/panorama", body)[0] == 200


def test_doubts_are_in_every_answer(server, scan):
    for query in ("", "?as=zip", "?as=json"):
        status, headers, data = server.ask("POST", f"/panorama{query}", scan[0])
        (doubt,) = json.loads(headers["lidar2pano-doubts"])
        assert status == 200 and doubt.startswith("only 60 of its points can be used")
    assert json.loads(data)["doubts"] == [doubt]
    status, _, data = server.ask("POST", "/panorama?strict=true", scan[0])
    assert status == 422 and "an error because of --strict" in json.loads(data)["error"]


def test_overrides_are_those_of_translate(scan):
    readings = []

    class Listener(StandIn):
        def step(self, memory, scan, pose, timer, labels=None, cameras=()):
            readings.append(scan.xyz.copy())
            return super().step(memory, scan, pose, timer, labels)

    with serving(Listener()) as server:
        for query in ("", "?forward=y", "?forward=&remission=none&strict=0"):
            assert server.ask("POST", f"/panorama{query}", scan[0])[0] == 200
    assert np.allclose(readings[1], readings[0][:, [1, 0, 2]] * (1, -1, 1)) and np.array_equal(readings[2], readings[0])


def form(*fields: tuple[str, bytes]) -> tuple[bytes, str]:
    parts = [
        b"--xx-\r\nContent-Disposition: form-data; %s\r\n\r\n%s\r\n" % (head.encode(), body) for head, body in fields
    ]
    return b"".join(parts) + b"--xx---\r\n", "multipart/form-data; boundary=xx-"


def test_a_form_of_one_file_is_its_file(server, scan):
    body, content_type = form(('name="file"; filename="a.bin"', scan[0]))
    status, headers, data = server.ask("POST", "/panorama", body, **{"Content-Type": content_type})
    assert status == 200 and np.array_equal(pixels(data), scan[1])
    for fields in ((), (('name="a"', b"1"), ('name="b"', b"2"))):
        body, content_type = form(*fields)
        status, _, data = server.ask("POST", "/panorama", body, **{"Content-Type": content_type})
        assert status == 422 and f"form: holds {len(fields)} fields" in json.loads(data)["error"]


@pytest.mark.parametrize("charset", [b"utf-8", b"a\0b", b"idna", b"punycode"])
def test_a_name_may_have_any_charset(charset):
    """As some clients send what is not ASCII; of a name its ending counts alone."""
    head = b"Content-Disposition: form-data; name=a; filename*=%s''%%80.pcd" % charset
    body = b"--x\r\n%s\r\n\r\nhello\r\n--x--\r\n" % head
    content, name = file_of_form(body, "multipart/form-data; boundary=x")
    assert content == b"hello" and name.endswith(".pcd")


# --- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("query", "body", "status", "message"),
    [
        ("", b"", 422, "the body is empty"),
        ("?name=../../etc/passwd", b"hello", 422, "scan: is text, but no table of points"),
        ("?name=a.bin", b"12345", 422, "scan: 5 bytes are no whole number of points"),
        ("?as=gif", b"1", 422, "as: there is png, zip, json"),
        ("?save=rbg", b"1", 422, "save: name some of rgb"),
        ("?save=all", b"1", 422, "a PNG holds rgb alone"),
        ("?fordward=x", b"1", 400, "did you mean 'forward'?; known are as, save, name, forward, remission"),
        ("?sensor_height=1", b"1", 400, "sensor_height: unknown parameter"),
        ("?as=png&as=json", b"1", 400, "as: stands twice"),
        ("?forward=up", b"1", 422, "forward 'up' is no axis; there is x, y, -x, -y"),
        ("?remission=7", b"1", 422, "remission '7' is no scale"),
        ("?sensor-height=high", b"1", 422, "sensor-height: 'high' is no height"),
        ("?sensor-height=-1", b"1", 422, "sensor-height -1.0 is no height"),
        ("?strict=perhaps", b"1", 422, "strict: is true or false"),
    ],
)
def test_what_cannot_be_used(server, query, body, status, message):
    found, headers, data = server.ask("POST", f"/panorama{query}", body)
    assert found == status and headers["content-type"] == "application/json"
    error = json.loads(data)["error"]
    assert message in error and "/tmp" not in error and "passwd" not in error


def test_limits_of_body_and_points(tmp_path):
    small = write_scan(tmp_path / "a.bin", street(60)).read_bytes()
    with serving(points=59, body_bytes=len(small)) as server:
        assert "60 points are too many (at most 59)" in json.loads(server.ask("POST", "/panorama", small)[2])["error"]
        assert server.ask("POST", "/panorama", small + b"0" * 16)[0] == 413
        chunks = socket.create_connection(("127.0.0.1", server.port), timeout=20)
        chunks.sendall(b"POST /panorama HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n")
        chunks.sendall(b"fff\r\n" + b"0" * 0xFFF + b"\r\n")  # its length is not announced
        assert chunks.recv(100).startswith(b"HTTP/1.1 413")
        chunks.close()
        assert server.waiting() == 0


def test_slow_uploads_and_slow_scans_end(scan):
    with serving(StandIn(seconds=0.6), upload_seconds=0.2, seconds=0.4) as server:
        slow = socket.create_connection(("127.0.0.1", server.port), timeout=20)
        slow.sendall(b"POST /panorama HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\n123")
        assert slow.recv(100).startswith(b"HTTP/1.1 408")
        slow.close()
        assert server.ask("POST", "/panorama", scan[0])[0] == 504
        assert server.waiting() == 0


@pytest.mark.parametrize(
    "path",
    ["/../../etc/passwd", "/results/../../etc/passwd/rgb", "/results/x/rgb", "/pages/index.html", "/%2e%2e/a", "//"],
)
def test_no_file_of_the_server_can_be_had(server, path):
    assert server.ask("GET", path)[0] == 404


def test_only_its_own_names_and_methods(server, scan):
    assert server.ask("GET", "/", Host="evil.example")[0] == 400
    assert server.ask("GET", "/", Host=f"localhost:{server.port}")[0] == 200
    assert server.ask("GET", "/panorama")[0] == 405


def test_a_bug_costs_one_request(server, tmp_path, scan):
    broken = street(60)
    broken.xyz[0] = (0, 2000, 0)
    status, _, data = server.ask("POST", "/panorama", write_scan(tmp_path / "b.bin", broken).read_bytes())
    assert status == 500 and b"bug" not in data and b"Traceback" not in data
    assert server.ask("POST", "/panorama", scan[0])[0] == 200


# --- strangers --------------------------------------------------------------------------------------------------------


class Impatient(BoundedConnection):
    silent_s, most_connections = 0.4, 8


@pytest.mark.parametrize(
    "words",
    [
        b"",
        b"GET / HTTP/1.1\r\nHost: localhost\r\n",
        b"GET /health HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n1",  # answered, its body never ends
        b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\nGET",  # the second request never ends
    ],
)
def test_a_silent_connection_is_closed(words):
    with serving(connection=Impatient) as server:
        silent = socket.create_connection(("127.0.0.1", server.port), timeout=20)
        silent.sendall(words)
        begin = time.monotonic()
        with suppress(ConnectionResetError):
            while silent.recv(4096):
                pass
        assert 0.2 < time.monotonic() - begin < 19
        silent.close()


def test_a_head_that_drips_is_not_waited_for():
    with serving(connection=Impatient) as server:
        slow = socket.create_connection(("127.0.0.1", server.port), timeout=20)
        with pytest.raises(OSError):  # noqa: PT011 a broken pipe or a reset
            for byte in b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 100:
                slow.sendall(bytes([byte]))
                time.sleep(0.05)
        slow.close()


@pytest.mark.parametrize("reads", [False, True])
def test_who_does_not_read_is_not_waited_for_and_who_reads_slowly_is(reads):
    """An answer of 30 MB, which no buffer of the system holds."""

    async def answers(scope: Any, _: Any, send: Any) -> None:
        if scope["type"] == "http":
            await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"30000000")]})
            await send({"type": "http.response.body", "body": bytes(30_000_000)})

    class Waiting(BoundedConnection):
        silent_s = 2.0

    with serving(connection=Waiting, application=answers) as server:
        slow = socket.create_connection(("127.0.0.1", server.port), timeout=20)
        slow.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        size = 0
        with suppress(ConnectionResetError):
            for _ in range(30 if reads else 0):  # a megabyte at a time, for longer than a silent one has
                time.sleep(Waiting.silent_s / 20)
                for _ in range(16):
                    size += len(slow.recv(1 << 16, socket.MSG_WAITALL))
            time.sleep(0 if reads else 2 * Waiting.silent_s)
            while data := slow.recv(1 << 20):
                size += len(data)
        assert (size > 30_000_000) == reads
        slow.close()


def test_many_silent_connections_keep_nobody_out(scan):
    class Patient(BoundedConnection):
        silent_s, most_connections = 60.0, 8

    with serving(connection=Patient) as server:
        silent = [socket.create_connection(("127.0.0.1", server.port), timeout=20) for _ in range(30)]
        assert server.ask("POST", "/panorama", scan[0])[0] == 200
        for one in silent:
            one.close()


def test_connections_that_come_at_once_close_as_many_others():
    """The loop takes up to a backlog of them before one that is closed is forgotten."""
    loop, state = asyncio.new_event_loop(), ServerState()
    config = uvicorn.Config(lambda: None, http=Impatient)
    transports = [mock.Mock() for _ in range(20)]
    for transport in transports:
        transport.get_write_buffer_size.return_value, transport.get_extra_info.return_value = 0, None
        Impatient(config, state, {}, loop).connection_made(transport)
    closed = [transport.abort.called for transport in transports]
    assert closed == [True] * 12 + [False] * 8
    loop.close()


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Origin": "https://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://["}, 403),
        ({"Sec-Fetch-Site": "cross-site"}, 403),
        ({"Sec-Fetch-Site": "same-site"}, 403),  # another port of this machine
        ({"Sec-Fetch-Site": "same-origin"}, 200),
        ({"Sec-Fetch-Site": "none"}, 200),
        ({"Origin": "http://localhost:1", "Host": "localhost:1"}, 200),
        ({"Origin": "http://localhost:2", "Host": "localhost:1"}, 403),
    ],
)
def test_pages_of_other_sites_cannot_ask(server, scan, headers, status):
    assert server.ask("POST", "/panorama", scan[0], **headers)[0] == status
    assert server.ask("GET", "/health", **headers)[0] == status


def test_a_link_from_elsewhere_may_be_followed(server):
    assert server.ask("GET", "/", **{"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"})[0] == 200


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1", 200),
        ("127.8.9.1:8360", 200),
        ("[::1]:8360", 200),
        ("LOCALHOST", 200),
        ("evil.example", 400),
        ("localhost.evil.example", 400),
        ("127.0.0.1.evil.example", 400),
        ("2130706433", 400),
        ("10.0.0.1", 400),
        ("[::1", 400),
        ("", 400),
    ],
)
def test_loopback_is_a_property_of_the_address(server, host, status):
    assert server.ask("GET", "/health", Host=host)[0] == status


@pytest.mark.parametrize(
    ("name", "expected"),
    [("127.0.0.1", True), ("127.0.0.2", True), ("::1", True), ("::ffff:127.0.0.1", True), ("0.0.0.0", False)]
    + [("::", False), ("localhost", False), ("evil.example", False)],
)
def test_addresses_of_this_machine_alone(name, expected):
    assert is_loopback(name) is expected


@pytest.mark.parametrize(("host", "status"), [("127.0.0.1", b"200"), ("evil.example", b"400")])
def test_a_target_may_be_absolute(server, host, status):
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as connection:
        connection.sendall(f"GET http://{host}/health HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        assert connection.recv(100).split()[1] == status


@pytest.mark.parametrize("megabytes", [2, 20])
def test_a_body_too_long_is_answered_to_clients_that_send_all_first(megabytes):
    with serving(body_bytes=1 << 20) as server:
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(f"http://127.0.0.1:{server.port}/panorama", bytes(megabytes << 20), timeout=20)
        assert refused.value.code == 413 and b"the body is longer" in refused.value.read()


def test_an_upload_that_takes_its_reader_down_costs_one_request(server, scan):
    lines = gzip.compress(b"1 2 3\n" * 9_000_000 + b"1 2\n", 1)
    begin = time.monotonic()
    status, _, data = server.ask("POST", "/panorama?name=a.txt.gz", lines)
    assert status == 422 and "of memory to be read" in json.loads(data)["error"], data
    assert time.monotonic() - begin < 20
    assert server.ask("POST", "/panorama", scan[0])[0] == 200


@pytest.mark.parametrize(
    ("method", "path", "headers"),
    [("GET", "/", {}), ("GET", "/health", {}), ("GET", "/none", {}), ("PUT", "/", {}), ("POST", "/panorama", {})]
    + [("GET", "/", {"Host": "evil.example"}), ("GET", "/health", {"Origin": "https://evil.example"})],
)
def test_headers_of_every_answer(server, method, path, headers):
    _, answer, _ = server.ask(method, path, **headers)
    assert (
        answer["content-type"]
        and answer["cache-control"] == "no-store"
        and answer["x-content-type-options"] == "nosniff"
    )
    assert answer["referrer-policy"] == "no-referrer" and "frame-ancestors 'self'" in answer["content-security-policy"]
    assert not [name for name in answer if name in {"server", "x-powered-by"} or name.startswith("access-control")]


def test_an_upload_lies_in_a_folder_of_its_own_while_it_is_read(tmp_path, monkeypatch, scan):
    modes = []

    def looked_at(path, **_):
        modes.append((path.parent.parent, path.parent.stat().st_mode & 0o777, path.name))
        raise InputError("enough")

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("lidar2pano.serve.uploads.read_cloud", looked_at)
    translator = UploadTranslator(pipeline=StandIn(), weights="", most_points=100)
    with pytest.raises(InputError, match="enough"):
        translator(scan[0], "../../x.pcd", ("rgb",))
    assert modes == [(tmp_path, 0o700, "scan.pcd")] and not list(tmp_path.glob("lidar2pano-*"))


# --- the queue --------------------------------------------------------------------------------------------------------


def test_a_full_queue_refuses_and_says_when_to_come_again(scan):
    with serving(StandIn(seconds=0.3), waiting=2) as server:
        first = [server.sent(scan[0]) for _ in range(2)]
        while server.waiting() < 2:
            time.sleep(0.01)
        status, headers, _ = server.ask("POST", "/panorama", scan[0])
        assert status == 429 and int(headers["retry-after"]) >= 1
        for connection in first:
            assert connection.recv(100).startswith(b"HTTP/1.1 200")
            connection.close()
        assert server.ask("POST", "/panorama", scan[0])[0] == 200


class Counting(StandIn):
    """Counts the scans that were begun, in `cards`."""

    def step(self, *arguments):
        self.cards["begun"] = self.cards.get("begun", 0) + 1
        return super().step(*arguments)


def test_a_client_that_goes_away_costs_nothing(scan):
    pipeline = Counting(seconds=0.3)
    with serving(pipeline) as server:
        first, second = server.sent(scan[0]), None
        while server.waiting() < 1:
            time.sleep(0.01)
        second = server.sent(scan[0])
        while server.waiting() < 2:
            time.sleep(0.01)
        second.close()
        while server.waiting() > 1:
            time.sleep(0.01)
        assert first.recv(100).startswith(b"HTTP/1.1 200")
        first.close()
        assert server.ask("POST", "/panorama", scan[0])[0] == 200
        assert pipeline.cards["begun"] == 2  # not the second one
        metrics = server.ask("GET", "/metrics")[2].decode()
        assert 'lidar2pano_requests_total{status="499"} 1.0' in metrics


def test_shutdown_finishes_what_was_taken(scan):
    with serving(StandIn(seconds=0.2)) as server:
        taken = [server.sent(scan[0]) for _ in range(3)]
        while server.waiting() < 3:
            time.sleep(0.01)
        server.server.should_exit = True
        server.thread.join(20)
        assert not server.thread.is_alive()
        assert [connection.recv(100)[:12] for connection in taken] == [b"HTTP/1.1 200"] * 3
        for connection in taken:
            connection.close()


def test_results_are_kept_for_a_while():
    now = [0.0]
    kept = KeptResults(Limits(kept=2, kept_seconds=10), lambda: now[0])
    results = [Result(files={}, points=number, dropped=0, milliseconds={}) for number in range(3)]
    names = [kept.keep(result) for result in results]
    assert len(set(names)) == 3
    assert all(len(base64.urlsafe_b64decode(name + "==")) >= 16 for name in names)  # nobody guesses 128 bits
    assert [kept.get(name) for name in names] == [None, results[1], results[2]]
    now[0] = 11
    assert kept.get(names[2]) is None


# --- what surrounds it ------------------------------------------------------------------------------------------------


def test_health_and_metrics(server, scan):
    server.ask("POST", "/panorama", scan[0])
    answer = json.loads(server.ask("GET", "/health")[2])
    assert answer == {"status": "ok", "weights": "stand-in", "device": "cpu", "waiting": 0}
    status, headers, data = server.ask("GET", "/metrics")
    assert status == 200 and headers["content-type"].startswith("text/plain")
    assert b'lidar2pano_requests_total{status="200"}' in data and b'stage_seconds_count{stage="paint"}' in data


def test_pages_load_nothing_from_elsewhere(server):
    for path in ("/", "/docs"):
        status, headers, data = server.ask("GET", path)
        assert status == 200 and headers["content-security-policy"].startswith("default-src 'none'")
        assert not re.search(r'(src|href)="(https?:)?//', data.decode())


def test_the_example_can_be_sent(server):
    status, headers, data = server.ask("GET", "/example")
    assert (status, headers["content-type"]) == (200, "application/octet-stream")
    assert data == demo_street().read_bytes()


def test_the_page_takes_scans_by_drop_choice_and_example(server):
    page = server.ask("GET", "/")[2].decode()
    for part in ('id="zone"', 'type="file"', 'id="example"', "<progress", 'addEventListener("drop"', "are invented"):
        assert part in page


def test_the_description_has_every_route(server):
    described = json.loads(server.ask("GET", "/openapi.json")[2])["paths"]
    application = create_application(UploadTranslator(pipeline=StandIn(), weights="", most_points=1), Limits())
    routes = {(route.path, method.lower()) for route in application.routes for method in route.methods - {"HEAD"}}
    pages = {("/", "get"), ("/docs", "get"), ("/openapi.json", "get")}
    assert {(path, method) for path, methods in described.items() for method in methods} == routes - pages


@pytest.mark.parametrize(
    ("name", "ending"),
    [
        ("a.bin", ".bin"),
        ("x/y.PCD", ".pcd"),
        ("a.csv.gz", ".csv.gz"),
        ("a.gz", ".gz"),
        ("a.sh", ""),
        ("../..", ""),
        ("", ""),
    ],
)
def test_of_names_only_known_endings_are_used(name, ending):
    assert known_ending(name) == ending


def test_parts():
    assert parse_parts("depth, rgb") == ("rgb", "depth")
    with pytest.raises(InputError, match="save: name some"):
        parse_parts("")


def test_twice_the_capacity(scan, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "runs"))
    module = importlib.import_module("serve_load")
    with serving(StandIn(seconds=0.02), waiting=3) as server:
        answers = module.load(f"http://127.0.0.1:{server.port}", scan[0], clients=6, seconds=1.0)
    assert set(answers.statuses) == {"200", "429"} and answers.wrong == 0
    assert answers.statuses["200"] > 1  # in a busy machine; fifty on an idle one


def test_the_command(random_weights, scan):
    """A process of its own: it says where it listens, no log names a result, SIGTERM lets it finish its work."""
    words = ["serve", "--port", "0", "--weights", str(random_weights), "--device", "cpu"]
    process = subprocess.Popen(
        [sys.executable, "-m", "lidar2pano", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        port = int(process.stdout.readline().rpartition(":")[2])
        server = Server(None, None, port)
        while server.ask("GET", "/health")[0] != 200:
            time.sleep(0.05)
        begin = time.monotonic()
        assert server.ask("POST", "/panorama", scan[0])[0] == 200
        usual_s = time.monotonic() - begin
        link = json.loads(server.ask("POST", "/panorama?as=json", scan[0])[2])["outputs"]["rgb"]
        assert server.ask("GET", link)[0] == 200
        taken = server.sent(scan[0])
        while server.waiting() < 1:
            time.sleep(0.005)
        process.send_signal(signal.SIGTERM)
        answer = taken.recv(100)
        taken.close()
        output, errors = process.communicate(timeout=60)
        assert link.split("/")[2] not in output + errors
        if usual_s < 1:  # in a machine too busy for a panorama in three seconds, it ends without
            assert answer.startswith(b"HTTP/1.1 200") and process.returncode == 0
            assert errors.count("\n") == 1 and "not for commercial use" in errors
    finally:
        process.kill()


def test_a_port_that_is_taken(server, capsys):
    assert main(["serve", "--port", str(server.port)]) == 2
    assert f"127.0.0.1 port {server.port}: cannot be listened on" in capsys.readouterr().err


def test_a_host_that_has_no_name_is_a_mistake(capsys):
    assert main(["serve", "--host", "ä" * 80, "--port", "0"]) == 2
    assert f"{'ä' * 80} port 0: cannot be listened on (it is no name)" in capsys.readouterr().err


def test_a_body_without_bound_is_a_mistake(capsys, monkeypatch):
    monkeypatch.setattr("lidar2pano.cli.batch.checked_options", mock.Mock())
    assert main(["serve", "--port", "0", "--max-megabytes", "inf"]) == 2
    assert "Invalid value for '--max-megabytes'" in capsys.readouterr().err
