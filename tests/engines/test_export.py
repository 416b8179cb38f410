from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lidar2pano.cli import main
from lidar2pano.cli.export import inputs_of, networks_of
from lidar2pano.corrections import BANK, BUILDING, FENCE, FOUR_WHEELED, PATCHES, ROAD, ROUGH, VEGETATION
from lidar2pano.engines import export as engine_export
from lidar2pano.engines import onnx_runner
from lidar2pano.engines.export import Exportable, check_exportable, export
from lidar2pano.errors import InputError
from lidar2pano.geometry.flat_ground import no_flat_fences
from lidar2pano.geometry.kerbs import weigh_by_height
from lidar2pano.geometry.measured_depth import measured_depth
from lidar2pano.geometry.outlines import evened
from lidar2pano.geometry.projection import Normalisation, project
from lidar2pano.geometry.roughness import weigh_by_roughness
from lidar2pano.geometry.solid_noise import noise_tile
from lidar2pano.geometry.surface import cylinder_points, slopes, viewpoint_height
from lidar2pano.geometry.whole_cars import WholeCars
from lidar2pano.geometry.whole_walls import no_patches, whole_walls
from lidar2pano.labels import COMMON15
from lidar2pano.models.scene_painter import GROUND, Known, framed, outlined, painter_inputs
from lidar2pano.pipeline import load
from lidar2pano.views import VIEWS
from random_weights import TRANSLATOR_VIEW, street, write_family, write_scan, write_weights

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
FILES = ["README.md", "noise.npy", "painter.onnx", "run.py", "segmenter.onnx", "translator.onnx"]
SLIM = {"widths": [8, 8, 8, 8], "looks": ["day", "dusk"], "look": "dusk"}


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    """A family of small untrained networks with a scene painter."""
    folder = write_family(tmp_path_factory.mktemp("export") / "small")
    views = {"panorama": TRANSLATOR_VIEW.as_dict()}
    write_weights(folder, "painter", "scene-painter", SLIM, views=views)
    return folder


@pytest.fixture(scope="module")
def graphs(weights) -> Path:
    """The family's graphs."""
    assert main(["export", str(weights), "--onnx", str(weights.parent / "graphs")]) == 0
    return weights.parent / "graphs"


def test_a_family_becomes_graphs_with_cards(weights, graphs):
    assert sorted(path.name for path in graphs.iterdir()) == FILES
    pipeline = load(weights, "cpu", "torch")
    for role, card in pipeline.cards.items():
        model = onnx.load(graphs / f"{role}.onnx")
        onnx.checker.check_model(model, full_check=True)
        assert [one.version for one in model.opset_import if one.domain == ""] == [20]
        assert {one.key: one.value for one in model.metadata_props}["card"] == card.to_json()
        tensors = (*model.graph.input, *model.graph.output)
        assert {each.type.tensor_type.shape.dim[0].dim_param for each in tensors} == {"batch"}
    readme = (graphs / "README.md").read_text()
    assert "| `painter.onnx` | scene-painter | `inputs` (batch, 31, 64, 580)" in readme and "{" not in readme


def test_the_runner_paints_what_the_pipeline_paints(weights, graphs, tmp_path, monkeypatch):
    scan = write_scan(tmp_path / "a.bin")
    done = subprocess.run(
        [sys.executable, "-W", "error", graphs / "run.py", scan, tmp_path / "a.ppm"],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    head, size, data = (tmp_path / "a.ppm").read_bytes().partition(b" 255\n")
    assert head == b"P6 1152 96" and size
    colour = np.frombuffer(data, dtype=np.uint8).reshape(96, 1152, 3)
    monkeypatch.setattr("lidar2pano.hardware.has_bfloat16", lambda device: False)
    monkeypatch.setattr("lidar2pano.pipeline.clean_up", pixel_labels)  # the runner leaves out this and whole cars
    pipeline = load(weights, "cpu", "torch")
    monkeypatch.setattr(
        "lidar2pano.pipeline.with_cars", lambda segments, depth_m, *_: WholeCars(segments, depth_m, None)
    )
    expected = pipeline(scan).colour
    assert (
        np.abs(colour.astype(int) - expected) <= 1
    ).mean() > 0.9  # of noise at voxels' borders float32 reads another


def pixel_labels(image, ids):
    rows = image.row.clamp(0, image.view.rows - 1)
    return torch.where(image.usable, ids[rows, image.column.clamp(0, image.view.columns - 1)].long(), 0)


@pytest.mark.parametrize("view", [VIEWS["hdl64e"], TRANSLATOR_VIEW], ids=["sphere", "cylinder"])
def test_the_runner_projects_as_we_do(view):
    scan = street()
    points = np.column_stack([scan.xyz, scan.remission])
    image, row, column, owner = onnx_runner.project(points, view.as_dict())
    expected = project(scan, view)
    assert np.array_equal(owner, expected.index.numpy())
    assert np.array_equal(row, expected.row.clamp(-1, view.rows).numpy())
    assert np.array_equal(column, expected.column.numpy())
    assert np.allclose(image, expected.channels.numpy(), atol=1e-6)


def test_the_runner_makes_the_painters_inputs_as_we_do(graphs, monkeypatch):
    monkeypatch.setattr(onnx_runner, "HERE", graphs)
    view = replace(TRANSLATOR_VIEW, rows=48, columns=96)
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(1, 16, 6, 12, generator=generator).repeat_interleave(8, 2).repeat_interleave(8, 3) * 3
    logits[:, 7, 30:, :] = 20  # road
    logits[:, 9, 5:28, 20:70] = 20  # building
    logits[:, 6, 24:36, 76:84] = 25  # person
    depth_m = 5 + 30 * torch.rand(1, 48, 96, generator=generator)
    image = project(street(), view).channels[None]
    segments = logits.softmax(1)
    expected, expected_fine = painter_inputs(
        outlined(segments, 2.0, depth_m, view), depth_m, image, view, known=Known(sun=True), unread=(9, 11)
    )
    arrays = (part[0].double().numpy() for part in (segments, depth_m, image))
    inputs, fine = onnx_runner.painter_inputs(*arrays, view.as_dict(), {"sharp": 2.0, "sun": True}, [9, 11])
    assert np.abs(inputs - expected[0].numpy())[:24].max() < 1e-4
    assert (np.abs(inputs - expected[0].numpy()) < 1e-4).mean((1, 2)).min() > 0.99  # at borders of voxels and houses
    assert (inputs[30] > 0.3).any(), "there are openings"
    assert np.abs(inputs[27:30, 24:36, 76:84]).mean() > 0.05, "and clothes"
    assert (np.abs(fine - expected_fine[0].numpy()) < 1e-3).mean() > 0.995  # at voxels' borders float32 reads another
    for x, rows, frame in zip(
        (inputs, fine), (16, 4), framed(*(torch.from_numpy(x)[None] for x in (inputs, fine))), strict=True
    ):
        assert np.array_equal(onnx_runner.framed(x, rows), frame[0])


def test_the_runner_keeps_what_was_measured_as_we_do():
    view = replace(TRANSLATOR_VIEW, rows=48, columns=96)
    generator = torch.Generator().manual_seed(0)
    image = project(street(), view).channels[None]
    ids = torch.randint(0, 16, (1, 6, 12), generator=generator).repeat_interleave(8, 1).repeat_interleave(8, 2)
    ids[:, 30:], ids[:, :20, ::24] = ROAD, VEGETATION
    depth_m = 5 + 30 * torch.rand(1, 48, 96, generator=generator)
    expected = measured_depth(depth_m, image, ids, view, ROAD, VEGETATION)[0].double().numpy()
    arrays = (part[0].double().numpy() for part in (depth_m, image, ids))
    found = onnx_runner.measured_depth(*arrays, view.as_dict())
    assert (np.abs(found / expected - 1) < 1e-4).mean() > 0.999  # rounding decides at limits


def test_the_runner_weighs_by_roughness_as_we_do():
    image = project(street(), replace(TRANSLATOR_VIEW, rows=48, columns=96)).channels[None]
    logits = torch.randn(1, 16, 48, 96, generator=torch.Generator().manual_seed(0))
    before, depth_m = logits.softmax(1)[0].double().numpy(), torch.linspace(1, 80, 96).expand(1, 48, 96)
    weigh_by_roughness(logits, image, depth_m, ROUGH)
    found = onnx_runner.weigh_by_roughness(before, image[0].double().numpy(), depth_m[0].double().numpy())
    assert np.allclose(found, logits.softmax(1)[0], atol=1e-4) and not np.allclose(found, before, atol=0.02)


@pytest.mark.parametrize("channels", [5, 6])
def test_the_runner_normalises_as_we_do(channels):
    image, normalise = project(street(), VIEWS["hdl64e"]), Normalisation.of(channels)
    found = onnx_runner.normalised(image.channels.double().numpy(), normalise.as_dict())
    assert np.allclose(found, normalise(image), atol=1e-2) and found.shape[0] == channels
    assert np.abs(found - normalise(image).numpy()).mean() < 1e-4


def test_the_runner_weighs_by_height_as_we_do():
    view = replace(TRANSLATOR_VIEW, rows=48, columns=96)
    logits = torch.randn(1, 16, 48, 96, generator=torch.Generator().manual_seed(0))
    before, depth_m = logits.softmax(1)[0].double().numpy(), torch.full((1, 48, 96), 70.0)
    depth_m[:, 28:] = 1.6 / torch.linspace(0.03, 0.25, 20)[:, None] * torch.linspace(1, 0.9, 96)
    best = torch.where(torch.arange(96) < 70, ROAD, 0).expand(1, 48, 96)
    weigh_by_height(logits, best, depth_m, view, ROAD, GROUND[1])
    arrays = (part[0].double().numpy() for part in (best, depth_m))
    found = onnx_runner.weigh_by_height(before, *arrays, view.as_dict())
    assert np.allclose(found, logits.softmax(1)[0], atol=1e-4) and not np.allclose(found, before, atol=0.02)


def test_the_runner_makes_walls_whole_as_we_do():
    view = replace(TRANSLATOR_VIEW, rows=48, columns=96)
    logits = torch.randn(1, 16, 48, 96, generator=torch.Generator().manual_seed(0))
    logits[:, BUILDING, 3:20], logits[:, FENCE, 20:30], logits[:, ROAD, 30:] = 20, 20, 20
    depth_m = torch.full((1, 48, 96), 12.0)
    depth_m[..., 40:60] = torch.linspace(20, 5, 48)[:, None]
    depth_m[:, 20:, 70:] = 8.0
    logits[:, FOUR_WHEELED[1], :, 30:36] = 40
    for each, columns in zip(FOUR_WHEELED, (slice(0, 8), slice(8, 16), slice(16, 24)), strict=True):
        logits[:, each, 8:12, columns] = 30
    segments, best = logits.softmax(1)[0].double().numpy(), logits.argmax(1)
    whole_walls(logits, best, *heights(best, depth_m, view), BUILDING, FENCE, FOUR_WHEELED)
    expected = logits.softmax(1)[0].double().numpy()
    surface = onnx_runner.radius_and_height(segments.argmax(0), depth_m[0].double().numpy(), view.as_dict())
    found = onnx_runner.whole_walls(segments, segments.argmax(0), *surface)
    assert np.allclose(found, expected, atol=1e-5) and not np.allclose(found, segments, atol=0.1)
    assert (found.argmax(0)[25] == FENCE).any(), "fences stay fences"
    assert (found.argmax(0)[9, :24] == BUILDING).all(), "vehicles on a wall are none"
    assert (found.argmax(0)[10:30, 30:36] == BUILDING).all(), "nor is what is taller"


def heights(best, depth_m, view):
    """Horizontal distances and heights above the road, (1, H, W) each."""
    radius_m, z_m = cylinder_points(depth_m, view)
    return radius_m, z_m + viewpoint_height(radius_m, z_m, best == ROAD, view)[:, None, None]


def test_the_runner_leaves_no_flat_fences_as_we_do():
    view = replace(TRANSLATOR_VIEW, rows=48, columns=96)
    logits = torch.randn(1, 16, 48, 96, generator=torch.Generator().manual_seed(0))
    logits[:, FENCE, 31:, 40:], logits[:, ROAD, 30:, :40], logits[:, FENCE, 20:, 70:80] = 20, 20, 20
    depth_m = torch.full((1, 48, 96), 12.0)
    depth_m[:, 28:] = 1.6 / torch.linspace(0.03, 0.25, 20)[:, None]
    depth_m[:, 28:, 80:].clamp_(max=9.0)
    slope = slopes(view)[:, None]
    depth_m[..., 70:80] = torch.where(slope < 0.6, 5.0 / (0.7 - slope), 60.0) * torch.sqrt(1 + slope.square())
    segments, best = logits.softmax(1)[0].double().numpy(), logits.argmax(1)
    surface = heights(best, depth_m, view)
    no_flat_fences(logits, best, *surface, GROUND, BANK, FENCE)
    found = onnx_runner.no_flat_fences(
        segments, best[0].numpy(), *onnx_runner.radius_and_height(best[0].numpy(), depth_m[0].numpy(), view.as_dict())
    )
    assert np.allclose(found, logits.softmax(1)[0], atol=1e-5) and not np.allclose(found, segments, atol=0.1)
    assert (found.argmax(0)[40, 85:] == FENCE).any() and (found.argmax(0)[-1, 45:65] != FENCE).all()
    assert np.isin(found.argmax(0)[20:40, 70:80], BANK).mean() > 0.3, "a slope is a bank"


def test_the_runner_leaves_no_patches_as_we_do():
    logits = torch.randn(1, 16, 48, 96, generator=torch.Generator().manual_seed(0))
    logits[:, BUILDING], logits[:, VEGETATION, :, 60:] = 4, 6
    logits[:, VEGETATION, 20:28, :40], logits[:, FENCE, 24:30, 50:], logits[:, FENCE, 35:40, :20] = 9, 9, 9
    radius_m = torch.full((1, 48, 96), 12.0)
    radius_m[:, 24:, 20:30] = 8.0
    segments, best = logits.softmax(1)[0].double().numpy(), logits.argmax(1)
    no_patches(logits, best, radius_m, PATCHES)
    found = onnx_runner.no_patches(segments, best[0].numpy(), radius_m[0].numpy())
    assert np.allclose(found, logits.softmax(1)[0], atol=1e-5)
    assert (found.argmax(0)[20:28, :20] == BUILDING).all() and (found.argmax(0)[20:28, 20:30] == VEGETATION).all()
    assert (found.argmax(0)[24:30, 60:] == VEGETATION).all() and (found.argmax(0)[24:30, 50:60] == BUILDING).all()
    assert (found.argmax(0)[35:40, :20] == BUILDING).all()


def test_the_runner_knows_the_classes():
    assert tuple(onnx_runner.CLASSES) == COMMON15.classes


def test_the_runner_evens_the_ground_as_we_do():
    logits = torch.randn(1, 16, 12, 460, generator=torch.Generator().manual_seed(0)) * 3
    expected = evened(logits, GROUND).softmax(1)[0].numpy()
    assert np.allclose(onnx_runner.evened(onnx_runner.softmax(logits[0].double().numpy())), expected, atol=1e-5)


# --- what does not agree is not written -----------------------------------------------------------------------------


def test_a_graph_that_differs_leaves_no_file(weights, graphs, tmp_path, monkeypatch):
    pipeline = load(weights, "cpu", "torch")
    inputs = inputs_of(pipeline)
    parts = {
        role: Exportable(network=network, model=pipeline.cards[role].network, card="{}", inputs=inputs[role])
        for role, network in networks_of(pipeline).items()
    }
    monkeypatch.setattr(
        engine_export, "graph", lambda network, model, inputs, metadata: onnx.load(graphs / f"{metadata['role']}.onnx")
    )
    noise = noise_tile(torch.device("cpu"), torch.float32).reshape(64, 64, 64).numpy()
    assert len(export(parts, tmp_path / "good", noise)) == len(FILES)
    with torch.no_grad():
        pipeline.translator.depth.bias += 1e-3
    with pytest.raises(
        InputError, match="graph of the 'titan-pano' differs from torch by .* in 'depth_m'; nothing was"
    ):
        export(parts, tmp_path / "bad", noise)
    assert not (tmp_path / "bad").exists()


def test_another_best_class_is_a_difference_unless_the_best_two_are_alike():
    reference = torch.tensor([1.0, 1.00005, 0.0])[None, :, None, None]
    assert not engine_export._other_best(reference[:, [1, 0, 2]], reference)
    assert engine_export._other_best(reference[:, [0, 2, 1]], reference)


def test_what_cannot_be_exported(tmp_path, monkeypatch, capsys):
    with pytest.raises(InputError, match="the painter is a 'vid2vid', which cannot be exported; name weights of sal"):
        check_exportable({"segmenter": "salsanext", "painter": "vid2vid"})
    monkeypatch.setattr("lidar2pano.engines.selection._is_installed", lambda module: module != "onnxscript")
    assert main(["export", "world", "--onnx", str(tmp_path / "graphs")]) == 2
    said = capsys.readouterr().err
    assert said == "lidar2pano: the export needs the extra 'onnx': pip install 'lidar2pano[onnx]'\n"
    assert not (tmp_path / "graphs").exists()


def test_cards_are_json(graphs):
    model = onnx.load(graphs / "segmenter.onnx")
    assert json.loads(next(one.value for one in model.metadata_props if one.key == "card"))["network"] == "salsanext"
