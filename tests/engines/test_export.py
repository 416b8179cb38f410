from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from installed_families import INSTALLED, needs_streets
from lidar2pano.cli import main
from lidar2pano.cli.export import networks_of, record_inputs
from lidar2pano.engines import export as engine_export
from lidar2pano.engines.export import Exportable, check_exportable, export
from lidar2pano.engines.runtimes import recordable
from lidar2pano.engines.signatures import SIGNATURES
from lidar2pano.errors import InputError
from lidar2pano.models.card import Card, save
from lidar2pano.models.card import load as load_weights
from lidar2pano.models.families import best_family, weight_files
from lidar2pano.pipeline import Pipeline, load
from random_weights import SEGMENTER_VIEW, TRANSLATOR_VIEW

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
PAINTER = ["painter-decoder.onnx", "painter-flow.onnx", "painter-mean.onnx"]  # of the best installed family
FILES = ["README.md", *PAINTER, "segmenter.onnx", "translator.onnx"]
VIEWS = {"input": SEGMENTER_VIEW.as_dict(), "panorama": TRANSLATOR_VIEW.as_dict()}


@pytest.fixture(scope="module")
def small_raster(tmp_path_factory) -> Callable[[str], Path]:
    """A folder with the released weights of a family, on a raster small enough for tests."""

    def write(family: str) -> Path:
        folder = tmp_path_factory.mktemp("export") / family
        folder.mkdir()
        for role, file in weight_files(family).items():
            network, card = load_weights(file)
            views = {name: VIEWS[name] for name in card.views if name in VIEWS}  # no rows are added
            save(folder / f"{role}.safetensors", network, replace(card, views=views))
        return folder

    return write


@pytest.fixture(scope="module")
def weights(small_raster) -> Path:
    """The best installed family."""
    return small_raster(best_family())


@pytest.fixture(scope="module")
def graphs(weights) -> Path:
    """Its graphs."""
    assert main(["export", str(weights), "--onnx", str(weights.parent / "graphs")]) == 0
    return weights.parent / "graphs"


def layers(card: Card) -> tuple[str, dict[str, object]]:
    """Return a network's name and its settings but for the numbers of its channels."""
    return card.network, {name: value for name, value in card.settings.items() if name not in ("widths", "pyramid")}


def exportable(pipeline: Pipeline) -> dict[str, Exportable]:
    """Return the parts of a pipeline as `export` takes them, by graph."""
    inputs = record_inputs(pipeline)
    return {
        name: Exportable(network=network, model=model, card="{}", inputs=inputs[name])
        for name, (_, model, network) in networks_of(pipeline).items()
    }


def test_a_family_becomes_graphs_with_cards(weights, graphs):
    assert sorted(path.name for path in graphs.iterdir()) == FILES
    pipeline = load(weights, "cpu", "torch")
    for file in graphs.glob("*.onnx"):
        card, model = pipeline.cards[file.stem.partition("-")[0]], onnx.load(file)
        onnx.checker.check_model(model, full_check=True)
        assert [one.version for one in model.opset_import if one.domain == ""] == [20]
        assert {one.key: one.value for one in model.metadata_props}["card"] == card.to_json()
        tensors = (*model.graph.input, *model.graph.output)
        assert {each.type.tensor_type.shape.dim[0].dim_param for each in tensors} == {"batch"}


@needs_streets
def test_the_readme_lists_every_tensor_of_every_graph(graphs):
    readme = (graphs / "README.md").read_text()
    assert "{" not in readme and "5. **Painter's `conditions`**" in readme
    assert "| `painter-flow.onnx` | `time` | input | (batch) | how much" in readme
    assert "| `painter-flow.onnx` | `noisy` | input | (batch, 32, 12, 144) | noise at first" in readme
    for file in graphs.glob("*.onnx"):
        graph = onnx.load(file).graph
        for kind, tensors in (("input", graph.input), ("output", graph.output)):
            for tensor in tensors:
                shape = ", ".join(str(one.dim_value) for one in tensor.type.tensor_type.shape.dim[1:])
                shape = ", ".join(["batch", *filter(None, [shape])])
                assert f"| `{file.name}` | `{tensor.name}` | {kind} | ({shape}) | " in readme


@pytest.mark.parametrize("family", [name for name in INSTALLED if name != best_family()])
def test_the_graphs_of_other_families_compute_what_torch_does(small_raster, weights, family, tmp_path):
    """Graphs of the networks that the best family has not; other weights and widths alone make no other graph."""
    known = [layers(card) for card in load(weights, "cpu", "torch").cards.values()]
    pipeline = load(small_raster(family), "cpu", "torch")
    roles = {role for role, card in pipeline.cards.items() if layers(card) not in known}
    parts = {role: part for role, part in exportable(pipeline).items() if role in roles}
    written = export(parts, tmp_path / "graphs")
    assert {path.stem for path in written if path.suffix == ".onnx"} == roles


# --- what does not agree is not written -----------------------------------------------------------------------------


def test_a_graph_that_differs_leaves_no_file(weights, graphs, tmp_path, monkeypatch):
    pipeline = load(weights, "cpu", "torch")
    parts = exportable(pipeline)
    monkeypatch.setattr(
        engine_export, "graph", lambda network, model, inputs, metadata: onnx.load(graphs / f"{metadata['role']}.onnx")
    )
    written = export(parts, tmp_path / "good")
    assert sorted(path.name for path in written) == FILES
    with torch.no_grad():
        pipeline.translator.depth.bias += 1e-3
    with pytest.raises(
        InputError, match="graph of the 'titan-pano' differs from torch by .* in 'depth_m'; nothing was"
    ):
        export(parts, tmp_path / "bad")
    assert not (tmp_path / "bad").exists()


def test_what_cannot_be_exported(tmp_path, monkeypatch, capsys):
    with pytest.raises(InputError, match="the painter is a 'vid2vid', which cannot be exported; name weights of sal"):
        check_exportable({"segmenter": "salsanext", "painter": "vid2vid"})
    monkeypatch.setattr("lidar2pano.engines._is_installed", lambda module: module != "onnxscript")
    assert main(["export", "world", "--onnx", str(tmp_path / "graphs")]) == 2
    said = capsys.readouterr().err
    assert said == "lidar2pano: the export needs the extra 'export': pip install 'lidar2pano[export]'\n"
    assert not (tmp_path / "graphs").exists()


def test_what_is_recorded_keeps_nothing_for_gradients():
    """Of panoramas it would be gigabytes."""
    network, image = torch.nn.Conv2d(1, 1, 3), torch.ones(1, 1, 8, 8)
    with torch.enable_grad():
        assert not recordable(network, (image,))(image).requires_grad
        assert network(image).requires_grad


def test_every_tensor_has_its_content_said():
    assert all(text for one in SIGNATURES.values() for text in (*one.inputs.values(), *one.outputs.values()))


def test_cards_are_json(graphs):
    model = onnx.load(graphs / "segmenter.onnx")
    assert json.loads(next(one.value for one in model.metadata_props if one.key == "card"))["network"] == "salsanext"
