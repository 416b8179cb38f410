"""lidar2pano serve."""

from __future__ import annotations

import signal
import socket
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from lidar2pano.cli import options as opt
from lidar2pano.cli.app import app
from lidar2pano.cli.console import print_weights
from lidar2pano.errors import InputError

MOST_CONCURRENT = 1000  # more than a server's connections
GRACEFUL_S = 2  # for requests at work, after SIGTERM


@app.command()
def serve(  # noqa: PLR0913, PLR0917 one parameter per option
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Address to listen on; the default takes calls of this machine only.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, metavar="N", help="Port; 0: any that is free.")] = 8360,
    weights: opt.WeightsOption = opt.BEST,
    look: opt.LookOption = "",
    quality: opt.QualityOption = "fast",
    seed: opt.SeedOption = 0,
    elevation: opt.ElevationOption = "",
    device: opt.DeviceOption = "auto",
    engine: opt.EngineOption = "auto",
    most_megabytes: Annotated[
        float, typer.Option("--max-megabytes", min=0.001, max=1e6, metavar="N", help="Of one request's body.")
    ] = 64,
    most_points: Annotated[int, typer.Option("--max-points", min=1, metavar="N", help="Of one scan.")] = 2_000_000,
    queue: Annotated[
        int, typer.Option(min=1, metavar="N", help="Requests that are taken at a time; others get 429.")
    ] = 8,
    seconds: Annotated[float, typer.Option(min=0.1, metavar="N", help="From a request to its answer.")] = 120,
) -> None:
    """Turn scans into panoramas over HTTP: POST /panorama; a page to drop scans on at /."""
    import uvicorn

    from lidar2pano.cli.batch import checked_options
    from lidar2pano.serve import BoundedConnection, Limits, UploadTranslator, create_application, is_loopback

    listening = _socket(host, port)
    options = checked_options(
        weights, **opt.collect_choices(device, engine, look, quality, seed, elevation), out=Path(), save=("rgb",)
    )
    limits = replace(Limits(), body_bytes=int(most_megabytes * 1e6), points=most_points, waiting=queue, seconds=seconds)
    pipeline = options.pipeline()
    print_weights(options.note, pipeline.cards.values())
    translator = UploadTranslator(
        pipeline=pipeline, weights=options.weights, most_points=limits.points, most_seconds=limits.seconds
    )
    name, bound = listening.getsockname()[:2]
    hosts = ["localhost"] if is_loopback(name) else None  # a page elsewhere may have a name for this machine
    application = create_application(translator, limits, hosts)
    config = uvicorn.Config(
        application,
        http=BoundedConnection,
        log_level="warning",
        server_header=False,
        proxy_headers=False,  # whoever calls from this machine could name himself anew for each request
        limit_concurrency=MOST_CONCURRENT,
        timeout_graceful_shutdown=GRACEFUL_S,
    )
    print(f"http://{f'[{name}]' if ':' in name else name}:{bound}", flush=True)
    signal.signal(signal.SIGTERM, lambda *_: None)  # uvicorn raises it again when all requests are answered
    uvicorn.Server(config).run(sockets=[listening])


def _socket(host: str, port: int) -> socket.socket:
    """Open the socket to listen on, before the model is loaded; InputError if it cannot be had."""
    try:
        host.encode("idna")
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, backlog=128)  # calls wait while the model is loaded
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no name"
        raise InputError(f"{host} port {port}: cannot be listened on ({reason}); choose others") from error
