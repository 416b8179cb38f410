"""A process that runs commands in children of its own and kills them: it reads jobs, a line of JSON each, from stdin.

A job: {"words": the command's, "signal": a signal's number, "after_s": when it is sent; null: never, "most_bytes": of a
file; null: any, "again_s": when the same command begins beside it; null: never}. The answer, of each of the two: the
exit code, negative for a signal, the seconds that the child ran, and what it wrote to stderr. Children begin with
everything imported. The one argument is the file for their stderr; that of the second ends in "-again".
"""

from __future__ import annotations

import json
import math
import os
import resource
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

import lidar2pano.train.engine  # noqa: F401 imported once, before any child begins
from lidar2pano.cli import console, main
from lidar2pano.cli.app import exit_status
from lidar2pano.cli.console import print_error
from lidar2pano.formats.image_files import write_whole
from lidar2pano.models import card  # noqa: F401
from lidar2pano.reproduce import run
from lidar2pano.simulate import generation  # noqa: F401
from lidar2pano.train.recipe import changed  # noqa: F401
from lidar2pano.train.recipes import RECIPES, recipe_named
from lidar2pano.views import VIEWS
from small_recipes import SMALL, VIEW, small
from toy_training import Denoise, entries, toy_recipe

ERRORS = Path(sys.argv[1])
NARROW = ((6, 8, 10), (1, 1, 1))
# Networks that a training takes milliseconds for, by recipe and role; other roles stay as they are.
NETWORKS: dict[str, dict[str, dict[str, object]]] = {
    "titan-pano-mini": {"translator": {"classes": 16, "conditions": 20, "widths": (8, 8, 8, 8, 8), "pyramid": 8}},
    "autoencoder-mini": {
        "autoencoder": {"latents": 4, "encoder": (8, 8, 8), "decoder": (8, 8, 8, 8)},
        "critic": {"conditions": 4, "mixed": 8, "width": 8},
    },
    "latent-painter-mini": {
        "painter": {"latents": 4, "autoencoder": ((4, 6, 8), (4, 4, 6, 8)), "mean": NARROW, "flow": NARROW, "code": 8}
    },
    "vid2vid-mini": {
        "painter": {"channels": 16, "widths": (4,), "downsamplings": 2, "blocks": (1, 1), "foreground": (1,)},
        "critic": {"channels": 19, "width": 4, "layers": 2},
        "temporal_1": {"width": 4, "layers": 2},
    },
}


def toy_training(out: str) -> int:
    """Train the toy's twelve steps, with a checkpoint after each."""
    threading.excepthook = lambda _: None  # as the program does
    Denoise.before_step = lambda _: time.sleep(0.02)
    try:
        lidar2pano.train.engine.train(toy_recipe("toy", checkpoint_minutes=1e-9), Path(), Path(out), device="cpu")
    except (KeyboardInterrupt, Exception) as error:
        code, line = exit_status(error)
        print_error(line)
        return code
    return 0


def shorten_recipes() -> None:
    """Let `train` and `reproduce` train tiny networks with a checkpoint after each step, and time none but these."""
    VIEWS.update(VIEW)
    for name in SMALL:
        recipe = small(name, "training.steps=99", "training.batch=1", "training.checkpoint_minutes=1e-9")
        RECIPES[name] = lambda recipe=recipe: recipe
    for name, settings in NETWORKS.items():
        recipe = recipe_named(name)
        networks = {
            role: replace(network, settings=settings.get(role, network.settings))
            for role, network in recipe.networks.items()
        }
        recipe = replace(recipe, networks=networks)
        RECIPES[name] = lambda recipe=recipe: recipe
    run._camera_segmenter_ms = lambda *_: None


def keep_graphs() -> None:
    """Let `export` record each graph once for all commands: it takes half a minute, in which nothing is written."""
    import onnx
    import onnxruntime  # noqa: F401
    import onnxscript  # noqa: F401

    from lidar2pano.engines import export, runtimes

    def graph(network: nn.Module, model: str, inputs: Any, metadata: dict[str, str]) -> Any:
        path = ERRORS.with_name(f"{metadata['role']}.onnx")
        if not path.is_file():
            proto = runtimes.graph(network, model, inputs, metadata)
            write_whole(path, lambda part: part.write_bytes(proto.SerializeToString()))
        return onnx.load(path)

    export.graph = graph


def child(words: list[str], most_bytes: int | None, errors: Path) -> int:
    """Run a command as the program does; `most_bytes` of a file it may write."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 1)
    os.dup2(os.open(errors, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), 2)
    if most_bytes is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
    torch.set_num_threads(1)
    if words[0] == "toy-training":
        return toy_training(words[1])
    sys.argv = ["lidar2pano", *words]
    return main()


def begin(job: dict[str, Any], errors: Path) -> int:
    """Begin a job's command and return the number of its process."""
    if process := os.fork():
        return process
    code = 99
    try:
        code = child(job["words"], job["most_bytes"], errors)
    finally:
        os._exit(code)


def end(process: int, errors: Path, began: float) -> tuple[int, float, str]:
    """Wait for a command and return its part of the answer."""
    _, status = os.waitpid(process, 0)
    return os.waitstatus_to_exitcode(status), time.monotonic() - began, errors.read_text(errors="replace")


def serve() -> None:
    """Do the jobs."""
    for table, name, value in entries():
        table[name] = value
    shorten_recipes()
    console.LINES_S = (math.inf,)  # on a busy machine lines about progress would stand among those that tests expect
    for line in sys.stdin:
        job = json.loads(line)
        if job["words"][0] == "export":
            keep_graphs()
        began = time.monotonic()
        begun = [(begin(job, ERRORS), ERRORS)]
        if job["again_s"] is not None:
            time.sleep(job["again_s"])
            again = ERRORS.with_name(f"{ERRORS.name}-again")
            begun.append((begin(job, again), again))
        if job["after_s"] is not None:
            time.sleep(job["after_s"])
            os.kill(begun[0][0], job["signal"])
        print(json.dumps([end(*one, began) for one in begun]), flush=True)


if __name__ == "__main__":
    serve()
