"""Loads a running server with more clients than it takes, and checks every answer.

python runs/serve_load.py URL SCAN [--clients 16] [--seconds 20] [--process PID]

Each client sends the scan again as soon as it has an answer; after 429 it waits a fifth of a second, less than it is
asked to. Printed as JSON: answers by status, the answers whose bytes differ from the first one, seconds of answers
(median and most), panoramas per second, and the server's memory at the begin and the end where its process is given.
"""

from __future__ import annotations

import argparse
import http.client
import json
import statistics
import threading
import time
import urllib.parse
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PAUSE_S = 0.2


@dataclass
class Answers:
    """What all clients got."""

    statuses: Counter[str] = field(default_factory=Counter)
    seconds: list[float] = field(default_factory=list)
    wrong: int = 0


def post(url: str, body: bytes) -> tuple[int, bytes, dict[str, str]]:
    """One request: status, body and headers of the answer."""
    place = urllib.parse.urlsplit(url)
    connection = http.client.HTTPConnection(place.hostname or "", place.port or 80, timeout=300)
    try:
        connection.request("POST", "/panorama", body)
        answer = connection.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())
    finally:
        connection.close()


def load(url: str, body: bytes, clients: int, seconds: float) -> Answers:
    """Let so many clients send the body for so long; the expected answer is that of a first request."""
    status, expected, _ = post(url, body)
    if status != 200:
        raise SystemExit(f"{url}: the first request got {status}: {expected[:300].decode(errors='replace')}")
    answers, lock, end = Answers(), threading.Lock(), time.monotonic() + seconds

    def client() -> None:
        while time.monotonic() < end:
            begin = time.monotonic()
            try:
                status, data, headers = post(url, body)
            except OSError as error:
                status, data, headers = 0, repr(error).encode(), {}
            with lock:
                bare = status == 429 and not headers.get("retry-after", "").isdecimal()
                answers.statuses[f"{status} without Retry-After" if bare else str(status)] += 1
                if status == 200:
                    answers.seconds.append(time.monotonic() - begin)
                    answers.wrong += data != expected
            if status != 200:
                time.sleep(PAUSE_S)

    threads = [threading.Thread(target=client) for _ in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return answers


def resident_mib(process: int) -> float:
    """Memory of a process, MiB (Linux)."""
    lines = Path(f"/proc/{process}/status").read_text(encoding="utf-8").splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("url")
    parser.add_argument("scan", type=Path)
    parser.add_argument("--clients", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--process", type=int)
    arguments = parser.parse_args()
    body = arguments.scan.read_bytes()
    for _ in range(3):  # the memory of the first panoramas is kept for the next
        post(arguments.url, body)
    initial_mib = resident_mib(arguments.process) if arguments.process else None
    answers = load(arguments.url, body, arguments.clients, arguments.seconds)
    report: dict[str, Any] = {
        "clients": arguments.clients,
        "seconds": arguments.seconds,
        "statuses": dict(answers.statuses),
        "wrong": answers.wrong,
        "median_s": round(statistics.median(answers.seconds), 2),
        "most_s": round(max(answers.seconds), 2),
        "panoramas_per_s": round(len(answers.seconds) / arguments.seconds, 2),
    }
    if arguments.process and initial_mib is not None:
        report |= {"memory_before_mib": round(initial_mib), "memory_after_mib": round(resident_mib(arguments.process))}
    print(json.dumps(report))


if __name__ == "__main__":
    main()
