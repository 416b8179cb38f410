"""lidar2pano export."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from lidar2pano.cli.app import app
from lidar2pano.cli.console import print_weights

if TYPE_CHECKING:
    from torch import Tensor, nn

    from lidar2pano.pipeline import Pipeline


@app.command()
def export(
    weights: Annotated[
        str, typer.Argument(metavar="WEIGHTS", help="A family of weights, a run's folder, or a weight file.")
    ],
    onnx: Annotated[
        Path, typer.Option("--onnx", metavar="DIR", help="Folder for the graphs and a README with their tensors.")
    ],
) -> None:
    """Write segmenter, translator and painter as ONNX graphs, each compared with torch first."""
    import torch

    from lidar2pano.appearance.invented_textures import BITS, noise_tile
    from lidar2pano.cli.options import check_folder
    from lidar2pano.engines.export import Exportable, check_exportable, export
    from lidar2pano.hardware import keep_buffers
    from lidar2pano.pipeline import load

    folder = check_folder(onnx, "--onnx")
    keep_buffers()
    pipeline = load(weights, "cpu", "torch")
    check_exportable({role: card.network for role, card in pipeline.cards.items()})
    networks, inputs = networks_of(pipeline), record_inputs(pipeline)
    parts = {
        role: Exportable(network=networks[role], model=card.network, card=card.to_json(), inputs=inputs[role])
        for role, card in pipeline.cards.items()
    }
    noise = noise_tile(torch.device("cpu"), torch.float32).reshape(3 * (2**BITS,))
    written = export(parts, folder, noise.numpy())
    print_weights("", pipeline.cards.values())
    print("\n".join(map(str, written)))


def networks_of(pipeline: Pipeline) -> dict[str, nn.Module]:
    """Return the networks by role."""
    return {
        "segmenter": pipeline.segmenter.network,
        "translator": pipeline.translator,
        "painter": cast("nn.Module", pipeline.painter),
    }


def record_inputs(pipeline: Pipeline) -> dict[str, tuple[Tensor, ...]]:
    """Return the networks' input tensors, by role, while the scan that ships with the package is translated."""
    from lidar2pano.demo import street

    inputs: dict[str, tuple[Tensor, ...]] = {}
    hooks = []
    for role, network in networks_of(pipeline).items():

        def keep(_: nn.Module, tensors: tuple[Tensor, ...], role: str = role) -> None:
            inputs[role] = tuple(tensor.float() for tensor in tensors)

        hooks.append(network.register_forward_pre_hook(keep))
    pipeline(street())
    for hook in hooks:
        hook.remove()
    return inputs
