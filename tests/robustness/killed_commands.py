"""A process that runs commands in children of its own and kills them: it reads jobs, a line of JSON each, from stdin.

A job: {"words": the command's, "signal": a signal's number, "after_s": when it is sent; null: never}. The answer: the
exit code, negative for a signal, and the seconds that the child ran. Children begin with everything imported.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import torch

import lidar2pano.train.engine  # noqa: F401 imported once, before any child begins
from lidar2pano.cli import main
from lidar2pano.models import card  # noqa: F401
from lidar2pano.train.overrides import changed  # noqa: F401
from toy_training import Denoise, entries, toy_recipe


def toy_training(out: str) -> int:
    """Train the toy's twelve steps, with a checkpoint after each."""
    Denoise.before_step = lambda _: time.sleep(0.02)
    try:
        lidar2pano.train.engine.train(toy_recipe("toy", checkpoint_minutes=1e-9), Path(), Path(out), device="cpu")
    except KeyboardInterrupt:
        return 130
    return 0


def child(words: list[str]) -> int:
    """Run a command as the program does."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 1)
    torch.set_num_threads(1)
    if words[0] == "toy-training":
        return toy_training(words[1])
    sys.argv = ["lidar2pano", *words]
    return main()


def serve() -> None:
    """Do the jobs."""
    for table, name, value in entries():
        table[name] = value
    for line in sys.stdin:
        job = json.loads(line)
        began = time.monotonic()
        process = os.fork()
        if not process:
            code = 99
            try:
                code = child(job["words"])
            finally:
                os._exit(code)
        if job["after_s"] is not None:
            time.sleep(job["after_s"])
            os.kill(process, job["signal"])
        _, status = os.waitpid(process, 0)
        print(json.dumps([os.waitstatus_to_exitcode(status), time.monotonic() - began]), flush=True)


if __name__ == "__main__":
    serve()
