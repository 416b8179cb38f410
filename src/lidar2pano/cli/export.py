"""lidar2pano export."""

from __future__ import annotations

from dataclasses import replace
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
    from lidar2pano.cli.options import check_folder
    from lidar2pano.engines.export import Exportable, check_exportable, export
    from lidar2pano.pipeline import load

    folder = check_folder(onnx, "--onnx")
    pipeline = load(weights, "cpu", "torch")
    networks = networks_of(pipeline)
    check_exportable({name: model for name, (_, model, _) in networks.items()})
    inputs = record_inputs(pipeline)
    cards = dict(pipeline.cards)  # with the raster of the graphs: translators may have learned taller ones
    cards["translator"] = replace(cards["translator"], views={"panorama": pipeline.view.as_dict()})
    parts = {
        name: Exportable(network=network, model=model, card=cards[role].to_json(), inputs=inputs[name])
        for name, (role, model, network) in networks.items()
    }
    written = export(parts, folder)
    print_weights("", pipeline.cards.values())
    print("\n".join(map(str, written)))


def networks_of(pipeline: Pipeline) -> dict[str, tuple[str, str, nn.Module]]:
    """Return role, model and network of what engines compute, by the name of its graph: the role, or ROLE-PART."""
    from lidar2pano.pipeline import engine_parts

    whole = {
        "segmenter": pipeline.segmenter.network,
        "translator": pipeline.translator,
        "painter": cast("nn.Module", pipeline.painter),
    }
    graphs: dict[str, tuple[str, str, nn.Module]] = {}
    for role, network in whole.items():
        parts = engine_parts(network, pipeline.cards[role].network)
        for model, part in parts.items():
            graphs[role if len(parts) == 1 else f"{role}-{model.split('-')[1]}"] = (role, model, part)
    return graphs


def record_inputs(pipeline: Pipeline) -> dict[str, tuple[Tensor, ...]]:
    """Return the networks' input tensors, by graph, while the scan of the package is translated."""
    from lidar2pano.demo import street

    inputs: dict[str, tuple[Tensor, ...]] = {}
    hooks = []
    for name, (_, _, network) in networks_of(pipeline).items():

        def keep(_: nn.Module, tensors: tuple[Tensor, ...], name: str = name) -> None:
            inputs[name] = tuple(tensor[:1].float() for tensor in tensors)

        hooks.append(network.register_forward_pre_hook(keep))
    pipeline(street())
    for hook in hooks:
        hook.remove()
    return inputs
