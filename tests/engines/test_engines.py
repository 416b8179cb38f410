from __future__ import annotations

import copy
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import nn

from engine_of_torch import SLIM, TorchEngine
from lidar2pano.engines import BUILDERS, ENGINES, accelerated, disk_cache, pick_engine
from lidar2pano.engines.compiled import MOST_SHAPES, CompiledForward, agrees, distance, other_classes
from lidar2pano.engines.runtimes import OnnxRuntime, OpenVino
from lidar2pano.engines.signatures import SIGNATURES, as_tuple
from lidar2pano.errors import InputError
from lidar2pano.models import build
from lidar2pano.models.titan_pano import with_rows
from lidar2pano.pipeline import engine_parts, load, made_fast
from lidar2pano.progress import shown_by
from lidar2pano.views import VIEWS
from random_weights import spread_norms, street

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LIDAR2PANO_CACHE", str(tmp_path / "cache"))


def network_of(model: str) -> nn.Module:
    torch.manual_seed(0)
    whole = "latent-painter" if model.startswith("latent-") else model
    return engine_parts(made_fast(spread_norms(build(whole, **SLIM[whole])).eval()), whole)[model]


def inputs_of(model: str, rows: int = 32, columns: int = 64) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(1)
    latents = (4, rows // 4, columns // 4)
    shapes = {
        "salsanext": [(5, rows, columns)],
        "titan-pano": [(5, rows, columns), (20, rows, columns)],
        "latent-mean": [(26, rows, columns), (2,)],
        "latent-flow": [(26, rows, columns), (2,), latents, latents, (), (128,), (5, *latents[1:]), (9,)],
        "latent-decoder": [latents],
    }[model]
    return tuple(torch.rand(1, *shape, generator=generator) for shape in shapes)


# --- the same outputs -------------------------------------------------------------------------------------------------


def test_onnx_runtime_computes_what_torch_does():  # the other networks: test_export.py
    pytest.importorskip("onnxruntime")
    model = "latent-decoder"
    network, inputs = network_of(model), inputs_of(model)
    exact = as_tuple(network(*inputs))
    engine = OnnxRuntime()
    outputs = engine.open(engine.build(network, model, tuple(tuple(each.shape) for each in inputs)), CPU)(inputs)
    assert [each.shape for each in outputs] == [each.shape for each in exact]
    for ours, reference in zip(outputs, exact, strict=True):
        assert (ours - reference).abs().max() < 1e-4 * reference.abs().max()


@pytest.mark.parametrize("model", SIGNATURES)
def test_openvino_computes_what_torch_does(model):
    pytest.importorskip("openvino")
    network, inputs = network_of(model), inputs_of(model)
    engine = OpenVino()
    outputs = engine.open(engine.build(network, model, tuple(tuple(each.shape) for each in inputs)), CPU)(inputs)
    assert agrees(network, model, inputs, outputs)
    with torch.inference_mode():
        assert [each.shape for each in outputs] == [each.shape for each in as_tuple(network(*inputs))]


def test_torch_compile_takes_the_place_of_the_call(monkeypatch):
    chosen = {}
    monkeypatch.setattr(nn.Module, "compile", lambda self, **settings: chosen.update(settings))
    network = network_of("titan-pano")
    assert accelerated(network, "titan-pano", "", "compile", CPU) is network
    assert chosen == {"dynamic": False, "mode": "default"}
    accelerated(network, "titan-pano", "", "compile", torch.device("cuda"))
    assert chosen["mode"] == "reduce-overhead"  # CUDA graphs


@contextmanager
def titles_of_work() -> Iterator[list[str]]:
    """Give the titles of the work that is announced inside."""
    titles: list[str] = []

    def show(total: int, title: str) -> nullcontext:
        titles.append(title)
        return nullcontext(lambda: None)

    with shown_by(show):
        yield titles


def test_compiling_is_announced(monkeypatch):
    def compile_network(self: nn.Module, **_: object) -> None:
        self._compiled_call_impl = self._call_impl

    monkeypatch.setattr(nn.Module, "compile", compile_network)
    inputs = inputs_of("titan-pano")
    network, plain = (accelerated(network_of("titan-pano"), "titan-pano", "", e, CPU) for e in ("compile", "torch"))
    with titles_of_work() as titles:
        outputs = network(*inputs)
        assert titles == ["compiling the titan-pano by torch.compile, anew in each process"]
        network(*inputs)
        assert len(titles) == 1, "the first call compiles"
        assert all(map(torch.equal, outputs, plain(*inputs)))
        for _ in range(2):
            forward_of(TorchEngine())(*inputs)
        assert titles[1:] == ["compiling the titan-pano for onnx, once for scans like this one; it is kept on disk"]


def test_openvino_reports_nothing_over_the_network():
    pytest.importorskip("openvino")
    code = (
        "import sys\nfrom lidar2pano.engines.runtimes import openvino\nopenvino()\n"
        "print([name for name in sys.modules if name.startswith('openvino_telemetry')])"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=120)
    assert done.stdout == "[]\n"


# --- which engine -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("installed", "bfloat16", "device", "engine"),
    [(True, True, "cpu", "openvino"), (False, True, "cpu", "torch"), (True, False, "cpu", "torch")]
    + [(True, True, "cuda", "torch")],
)
def test_auto(monkeypatch, installed, bfloat16, device, engine):
    monkeypatch.delenv("LIDAR2PANO_ENGINE")
    monkeypatch.setattr("lidar2pano.engines._is_installed", lambda module: installed)
    monkeypatch.setattr("lidar2pano.engines.has_bfloat16", lambda device: bfloat16)
    assert pick_engine("auto", torch.device(device)) == engine


def test_the_environment_names_what_auto_is(monkeypatch):
    monkeypatch.setenv("LIDAR2PANO_ENGINE", "compile")
    assert (pick_engine("auto", CPU), pick_engine("torch", CPU)) == ("compile", "torch")
    monkeypatch.setenv("LIDAR2PANO_ENGINE", "fast")
    with pytest.raises(InputError, match="no engine 'fast'"):
        pick_engine("auto", CPU)


def test_what_a_device_lacks(monkeypatch):
    monkeypatch.setattr("lidar2pano.engines._is_installed", lambda module: True)
    monkeypatch.setattr("lidar2pano.engines._providers", lambda: ["CPUExecutionProvider"])
    cuda = torch.device("cuda")
    for engine, says in (("openvino", "does not compute on cuda"), ("onnx", "install onnxruntime-gpu")):
        with pytest.raises(InputError, match=says):
            pick_engine(engine, cuda)
    assert [pick_engine(engine, CPU) for engine in ENGINES[1:]] == list(ENGINES[1:])


def test_networks_for_torch_only(monkeypatch):
    monkeypatch.setattr("lidar2pano.engines.missing_extra", lambda engine: "")
    monkeypatch.setenv("LIDAR2PANO_ENGINE", "openvino")
    network = nn.Conv2d(1, 1, 1)
    assert accelerated(network, "vid2vid", "", "auto", CPU) is network and "forward" not in vars(network)
    with pytest.raises(InputError, match="a 'vid2vid' runs with --engine torch only, not with openvino"):
        accelerated(network, "vid2vid", "", "openvino", CPU)


# --- compiled once, checked, kept -------------------------------------------------------------------------------------


@pytest.fixture
def builds(monkeypatch):
    """Names of the networks that were built."""
    names: list[str] = []
    monkeypatch.setattr(TorchEngine, "builds", names)
    return names


def forward_of(engine: TorchEngine, weights: str = "w", *, optional: bool = False) -> CompiledForward:
    return CompiledForward(
        network_of("titan-pano"), "titan-pano", weights, engine, compiles=not optional, optional=optional
    )


def test_a_network_is_built_once_per_shape_and_weights(builds):
    inputs = inputs_of("titan-pano")
    forward = forward_of(TorchEngine())
    first, second = forward(*inputs), forward(*inputs)
    assert len(builds) == 1 and all(torch.equal(*pair) for pair in zip(first, second, strict=True))
    forward_of(TorchEngine())(*inputs)
    assert len(builds) == 1, "another process takes it from the disk"
    forward_of(TorchEngine(), weights="others")(*inputs)
    forward(*inputs_of("titan-pano", columns=32))
    assert len(builds) == 3
    forward_of(TorchEngine(), weights="")(*inputs)
    forward_of(TorchEngine(), weights="")(*inputs)
    assert len(builds) == 5, "nothing on disk without a checksum"


@pytest.mark.parametrize("engine", [OpenVino, TorchEngine])
def test_rows_of_other_elevations_are_read_by_engines(engine):
    if engine is OpenVino:
        pytest.importorskip("openvino")
    network, (image, condition) = network_of("titan-pano"), inputs_of("titan-pano")
    usual = replace(VIEWS["panorama"], rows=32, columns=64)
    forward = CompiledForward(network, "titan-pano", "w", engine(), compiles=True, optional=False)
    for view in (usual, replace(usual, up=0.6), replace(usual, down=-0.6)):
        inputs = with_rows(image, view), condition
        assert agrees(network, "titan-pano", inputs, as_tuple(forward(*inputs))), view
    assert len(forward._runs) == 2


def test_few_shapes_are_held(builds):
    forward = forward_of(TorchEngine(), weights="")
    for number in range(MOST_SHAPES + 1):
        forward(*inputs_of("titan-pano", rows=16, columns=32 * (number + 1)))
    assert len(forward._runs) == MOST_SHAPES
    forward(*inputs_of("titan-pano", rows=16, columns=32))
    assert len(builds) == MOST_SHAPES + 2


@pytest.mark.parametrize(
    "damage",
    [lambda whole: whole[:-9], lambda whole: b"", lambda whole: whole[:50] + bytes([whole[50] ^ 1]) + whole[51:]],
)
def test_a_damaged_file_is_built_again(builds, damage):
    inputs = inputs_of("titan-pano")
    expected = forward_of(TorchEngine())(*inputs)
    (file,) = disk_cache.cache_folder().iterdir()
    file.write_bytes(damage(file.read_bytes()))
    assert torch.equal(forward_of(TorchEngine())(*inputs)[0], expected[0])
    assert len(builds) == 2
    forward_of(TorchEngine())(*inputs)
    assert len(builds) == 2, "it was replaced"


def test_what_another_version_wrote_is_built_again(builds):
    inputs = inputs_of("titan-pano")
    forward_of(TorchEngine())(*inputs)
    (file,) = disk_cache.cache_folder().iterdir()
    disk_cache.store(file.stem, b"not what torch.load takes, but its checksum is right")
    forward_of(TorchEngine())(*inputs)
    assert len(builds) == 2


def test_an_engine_that_disagrees_is_refused_and_not_tried_again(builds):
    inputs = inputs_of("titan-pano")
    network = network_of("titan-pano")
    for _ in range(2):
        logits, _ = forward_of(TorchEngine(error=1.0), optional=True)(*inputs)
        assert torch.equal(logits, network(*inputs)[0])
        with pytest.raises(InputError, match="network 'titan-pano': its outputs are farther .*; use --engine torch"):
            forward_of(TorchEngine(error=1.0))(*inputs)
    assert len(builds) == 1


def test_auto_compiles_nothing_and_takes_what_was_compiled(builds):
    inputs = inputs_of("titan-pano")
    forward_of(TorchEngine(), optional=True)(*inputs)
    assert len(builds) == 0 and not disk_cache.cache_folder().exists()
    forward_of(TorchEngine())(*inputs)
    chosen = forward_of(TorchEngine(), optional=True)
    chosen(*inputs)
    assert len(builds) == 1 and None not in chosen._runs.values()


@pytest.mark.parametrize(("variable", "count"), [("openvino", 1), ("auto", 0), ("", 0)])
def test_an_engine_that_the_environment_names_compiles(builds, monkeypatch, variable, count):
    monkeypatch.setenv("LIDAR2PANO_ENGINE", variable)
    monkeypatch.setattr("lidar2pano.engines._is_installed", lambda module: True)
    monkeypatch.setattr("lidar2pano.engines.has_bfloat16", lambda device: True)
    monkeypatch.setitem(BUILDERS, "openvino", TorchEngine)
    inputs = inputs_of("titan-pano")
    accelerated(network_of("titan-pano"), "titan-pano", "w", "auto", CPU)(*inputs)
    assert len(builds) == count, "auto alone compiles nothing"
    unfit = partial(TorchEngine, failure="no kernel")
    monkeypatch.setitem(BUILDERS, "openvino", unfit)
    network = network_of("titan-pano")
    expected = network(*inputs)[0]
    assert torch.equal(accelerated(network, "titan-pano", "v", "auto", CPU)(*inputs)[0], expected), "torch takes over"


def test_auto_asks_no_engine_where_nothing_was_compiled(builds, monkeypatch):
    requests = []
    monkeypatch.setattr(TorchEngine, "conditions", lambda self: requests.append(self) or "as ever")
    inputs = inputs_of("titan-pano")
    forward_of(TorchEngine(), optional=True)(*inputs)
    assert not requests, "importing an engine takes longer than loading a network"
    forward_of(TorchEngine())(*inputs)
    forward_of(TorchEngine(), optional=True)(*inputs)
    assert len(requests) == 2 and len(builds) == 1


def test_an_engine_that_fails(builds):
    inputs, network = inputs_of("titan-pano"), network_of("titan-pano")
    logits, _ = forward_of(TorchEngine(failure="no kernel\nfor this"), optional=True)(*inputs)
    assert torch.equal(logits, network(*inputs)[0])
    with pytest.raises(InputError, match=r"cannot be compiled \(no kernel\); use --engine torch"):
        forward_of(TorchEngine(failure="no kernel\nfor this"))(*inputs)
    assert not disk_cache.cache_folder().exists()


def test_a_mistake_in_the_inputs_is_reported_as_torch_does():
    with pytest.raises(InputError, match="rows, columns must divide by 16"):
        forward_of(TorchEngine(failure="whatever"))(*inputs_of("titan-pano", rows=20))


def test_class_scores_and_differences():
    reference = torch.tensor([[0.0, 1.0, 0.0, 1.0], [1.0, 0.0, 1.0, 0.0]])[None, :, None]
    assert other_classes(reference.flip(1), reference) == 1
    assert distance(reference, reference) == 0
    assert distance(reference + 0.1, reference) == pytest.approx(0.1 / 0.5**0.5)
    network, inputs = network_of("titan-pano"), inputs_of("titan-pano")
    logits, depth_m = network(*inputs)
    assert agrees(network, "titan-pano", inputs, (logits, depth_m))
    assert not agrees(network, "titan-pano", inputs, (logits, depth_m * 1.1))
    assert not agrees(network, "titan-pano", inputs, (logits.roll(1, 1), depth_m))
    assert not agrees(network, "titan-pano", inputs, (logits * torch.nan, depth_m))


# --- the folder -------------------------------------------------------------------------------------------------------


def test_what_was_used_longest_ago_goes_first(monkeypatch):
    monkeypatch.setattr(disk_cache, "LIMIT_BYTES", 3 * 132)
    for age, name in enumerate("abc"):
        disk_cache.store(name, name.encode() * 100)
        os.utime(disk_cache.cache_folder() / f"{name}.compiled", (1000 + age, 1000 + age))
    assert disk_cache.fetch("a") == b"a" * 100
    disk_cache.store("d", b"d" * 100)
    assert [disk_cache.fetch(name) is not None for name in "abcd"] == [True, False, True, True]


def test_a_folder_that_cannot_be_written_is_done_without(tmp_path, monkeypatch, builds):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("LIDAR2PANO_CACHE", str(tmp_path / "file" / "below"))
    inputs = inputs_of("titan-pano")
    forward_of(TorchEngine())(*inputs)
    forward_of(TorchEngine())(*inputs)
    assert len(builds) == 2


def test_the_users_cache_folder(monkeypatch, tmp_path):
    monkeypatch.delenv("LIDAR2PANO_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    assert disk_cache.cache_folder() == tmp_path / "lidar2pano" / "engines"


# --- in the pipeline --------------------------------------------------------------------------------------------------


def test_the_pipeline_paints_the_same_by_an_engine(random_weights, monkeypatch, builds):
    monkeypatch.setattr("lidar2pano.engines.BUILDERS", {"onnx": TorchEngine})
    monkeypatch.setattr("lidar2pano.engines.missing_extra", lambda engine: "")
    monkeypatch.setattr("lidar2pano.engines._providers", lambda: ["CPUExecutionProvider"])
    usual, ours = (load(random_weights, "cpu", engine) for engine in ("torch", "onnx"))
    assert (usual.engine, ours.engine) == ("torch", "onnx")
    first, second = usual(street()), ours(street())
    parts = ["salsanext", "titan-pano", "latent-mean", "latent-flow", "latent-decoder"]
    assert builds == parts
    assert (first.labels == second.labels).mean() > 0.95
    assert (first.segments == second.segments).mean() > 0.95
    again = copy.copy(ours)(street(seed=2))
    assert again.colour.shape == first.colour.shape and builds == parts
