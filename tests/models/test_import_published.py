"""Checkpoint files as the authors' trainers write them, and malformed ones."""

from __future__ import annotations

import inspect
import json
import pickle
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from golden_fill import fill
from lidar2pano.cli import main
from lidar2pano.errors import InputError
from lidar2pano.models import MODELS, build
from lidar2pano.models.camera_teachers import CameraSegmenter
from lidar2pano.models.card import load, read_card, save
from lidar2pano.models.families import licence_note, role
from lidar2pano.models.published import PUBLISHED, import_published, published_card
from lidar2pano.views import VIEWS, View


def test_a_titan_checkpoint_is_a_plain_state_dict(tmp_path: Path) -> None:
    theirs = build("titan").state_dict()
    torch.save({f"module.{key}": value for key, value in theirs.items()}, tmp_path / "training_generator_9.pth")
    ours = import_published(tmp_path / "training_generator_9.pth", "titan").state
    assert list(ours) == list(theirs)
    assert all(torch.equal(ours[key], value) for key, value in theirs.items())


class CyclicLR:
    """Torch 1.1's scheduler as pickle sees it: it drags along the optimizer and one of its own methods."""

    def __init__(self, optimizer: torch.optim.Optimizer) -> None:
        self.optimizer, self.base_lrs, self.scale_fn = optimizer, [0], self._triangular_scale_fn

    def _triangular_scale_fn(self, x: float) -> float:
        return x


@pytest.mark.parametrize("zipped", [False, True])
def test_a_salsanext_checkpoint_with_its_scheduler_inside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zipped: bool
) -> None:
    model = build("salsanext")
    optimizer = torch.optim.SGD([{"params": model.parameters()}], lr=0.1, momentum=0.9)
    model(torch.randn(2, 5, 32, 32)).sum().backward()
    optimizer.step()
    monkeypatch.setattr(CyclicLR, "__module__", "torch.optim.lr_scheduler")
    monkeypatch.setattr(torch.optim.lr_scheduler, "CyclicLR", CyclicLR)
    content = {
        "epoch": 149,
        "state_dict": {f"module.{key}": value for key, value in model.state_dict().items()},
        "optimizer": optimizer.state_dict(),
        "info": {"best_val_iou": 0.59},
        "scheduler": {"initial_scheduler": CyclicLR(optimizer), "lr": 0.01, "finished": True},
    }
    torch.save(content, tmp_path / "SalsaNext", _use_new_zipfile_serialization=zipped)
    monkeypatch.undo()
    with pytest.raises(pickle.UnpicklingError):
        torch.load(tmp_path / "SalsaNext", weights_only=True)
    allowed = set(torch.serialization.get_safe_globals())
    ours = import_published(tmp_path / "SalsaNext", "salsanext").state
    assert all(torch.equal(ours[key], value) for key, value in model.state_dict().items())
    assert set(torch.serialization.get_safe_globals()) == allowed


class Hostile:
    def __init__(self, function: object, *arguments: object) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return self.function, self.arguments


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize("function", [exec, eval, getattr, open])
def test_a_hostile_checkpoint_is_refused_and_runs_nothing(tmp_path: Path, function: object, zipped: bool) -> None:
    marker = tmp_path / "marker"
    code = f"__import__('pathlib').Path({str(marker)!r}).touch()"
    arguments = {exec: (code,), eval: (code,), getattr: (Path(marker), "touch"), open: (str(marker), "w")}[function]
    content = {"state_dict": build("titan").state_dict(), "info": Hostile(function, *arguments)}
    torch.save(content, tmp_path / "bad.pth", _use_new_zipfile_serialization=zipped)
    with pytest.raises(InputError, match="cannot be read as weights") as caught:
        import_published(tmp_path / "bad.pth", "titan")
    assert not marker.exists()
    assert "\n" not in str(caught.value)


def _wrong_content(how: str) -> object:
    state = build("titan").state_dict()
    bias = state["logits.bias"]
    return {
        "missing": lambda: {key: value for key, value in state.items() if key != "logits.bias"},
        "extra": lambda: state | {"head.weight": torch.zeros(1)},
        "another": lambda: build("titan-critic", width=1).state_dict(),
        "twice": lambda: state | {"module.logits.bias": bias},
        "no tensor": lambda: state | {"logits.bias": 3},
        "sparse": lambda: state | {"logits.bias": bias.to_sparse()},
        "double": lambda: state | {"logits.bias": bias.double()},
        "longer": lambda: state | {"logits.bias": torch.zeros(16)},
        "list": lambda: [1, 2],
        "nested": lambda: {"state_dict": ["logits.bias"]},
        "numbered": lambda: {1: bias},
    }[how]()


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("missing", "1 tensors are missing, the first is 'logits.bias'"),
        ("extra", "1 tensors are unexpected, the first is 'head.weight'"),
        ("another", "are missing, the first is 'downCntx.conv1.bias'"),
        ("twice", "the same weights twice"),
        ("no tensor", "'logits.bias' is no plain tensor"),
        ("sparse", "'logits.bias' is no plain tensor"),
        ("double", "'logits.bias' is of type torch.float64"),
        ("longer", "'logits.bias' has shape [16], expected [15]"),
        ("list", "no table of weights"),
        ("nested", "no table of weights"),
        ("numbered", "no table of weights"),
    ],
)
def test_a_wrong_checkpoint_is_named_in_one_line(tmp_path: Path, how: str, says: str) -> None:
    torch.save(_wrong_content(how), tmp_path / "weights.pth")
    _assert_refused(tmp_path / "weights.pth", says)


def test_a_file_that_is_no_checkpoint_is_named_in_one_line(tmp_path: Path) -> None:
    whole = tmp_path / "weights.pth"
    torch.save(build("titan").state_dict(), whole)
    for name, content in {
        "cut": whole.read_bytes()[:100_000],
        "page": b"<html>Sign in to download</html>",
        "empty": b"",
        "pickle": pickle.dumps({"weights": [1.0]}, protocol=5),
    }.items():
        (tmp_path / name).write_bytes(content)
        _assert_refused(tmp_path / name, "cannot be read as weights")
    _assert_refused(tmp_path, "no checkpoint file")
    _assert_refused(tmp_path / "absent", "no checkpoint file")


def _assert_refused(path: Path, says: str) -> None:
    with pytest.raises(InputError) as caught:
        import_published(path, "titan")
    assert str(path) in str(caught.value)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_networks_without_published_weights_are_named() -> None:
    with pytest.raises(InputError, match="did you mean 'titan'"):
        import_published("weights.pth", "titann")
    assert all(row.upstream.startswith("https://") and row.licence for row in PUBLISHED.values())


# --- how a network was built ------------------------------------------------------------------------------------------

GOLDEN_KEYS = {
    # keys in the golden folder: network, and settings beside the network's own defaults
    "hrnet_ocr_mscale_two": ("sdnet", {}),
    "vid2vid_512_scale1": ("vid2vid", {"widths": [128]}),
    "vid2vid_2048_scale3": ("vid2vid", {}),
    "vid2vid_1024_g1_scale3": ("vid2vid", {"downsamplings": 2}),
    "vid2vid_single_512": ("vid2vid-single", {}),
    "vid2vid_single_2048": ("vid2vid-single", {"width": 32, "downsamplings": 4, "enhancers": 1}),
    "vid2vid_D_image": ("vid2vid-image-critic", {}),
    "vid2vid_D_temporal": ("vid2vid-temporal-critic", {}),
    "pix2pix_unet256": ("pix2pix", {"inputs": 25, "outputs": 15}),
    "pix2pix_patchgan": ("pix2pix-critic", {}),
}


def keys_of(path: Path) -> dict[str, tuple[int, ...]]:
    """The shapes in one of the golden folder's lists of keys."""
    lines = (line.split("\t") for line in path.read_text().splitlines() if not line.startswith("#"))
    return {key: tuple(json.loads(shape)) for key, shape, *_ in lines}


@pytest.mark.parity
@pytest.mark.parametrize("name", GOLDEN_KEYS)
def test_settings_of_the_published_networks(golden: Path, name: str) -> None:
    network, special = GOLDEN_KEYS[name]
    shapes = keys_of(golden / f"{name}.keys.txt")
    settings = PUBLISHED[network].settings(shapes)
    defaults = {key: value.default for key, value in inspect.signature(MODELS[network]).parameters.items()}
    expected = defaults | special
    if name in {"vid2vid_512_scale1"}:
        expected["blocks"] = (9, 0)  # there is no finer scale
    if name == "vid2vid_single_512":
        expected["local_blocks"] = 0
    if "batch_statistics" in expected:
        expected["batch_statistics"] = True
    plain = json.loads(json.dumps(expected))
    assert json.loads(json.dumps(settings)) == {key: plain[key] for key in settings}
    with torch.device("meta"):
        ours = build(network, **settings).state_dict()
    assert {key: tuple(value.shape) for key, value in ours.items()} == shapes


# network -> settings of small instances; all but the default ones must be recognised from the weights
SMALL: dict[str, list[dict[str, Any]]] = {
    "sdnet": [
        {"width": 4, "stem": 8, "blocks": 1, "modules": [1, 1, 1], "context": 16},
        {"classes": 5, "width": 6, "stem": 4, "blocks": 2, "modules": [2, 1, 3], "context": 8},
    ],
    "vid2vid": [
        {"channels": 36, "widths": [8, 4, 2], "downsamplings": 3, "blocks": [5, 2]},
        {"channels": 35, "widths": [4, 2], "downsamplings": 2, "blocks": [2, 1], "frames": 2},
        {"channels": 16, "widths": [4], "downsamplings": 1, "blocks": [3, 0], "foreground": [], "frames": 4},
    ],
    "vid2vid-single": [
        {"width": 4, "downsamplings": 2, "blocks": 3, "local_blocks": 0},
        {"classes": 16, "width": 2, "downsamplings": 3, "blocks": 1, "enhancers": 1, "local_blocks": 2},
        {"classes": 16, "width": 2, "downsamplings": 1, "blocks": 2, "enhancers": 2, "local_blocks": 1},
    ],
    "vid2vid-image-critic": [{"channels": 7, "width": 4, "layers": 2, "scales": 3}],
    "vid2vid-temporal-critic": [{"channels": 13, "width": 8, "layers": 3, "scales": 1}],
    "pix2pix": [
        {"inputs": 5, "outputs": 2, "width": 2, "depth": 8},
        {"inputs": 1, "width": 3, "depth": 2, "norm": "instance", "batch_statistics": False},
    ],
    "pix2pix-critic": [{"channels": 9, "width": 2, "layers": 3}, {"width": 4, "layers": 1, "norm": "instance"}],
}
every_small = pytest.mark.parametrize(
    ("network", "settings"), [(network, one) for network, some in SMALL.items() for one in some]
)


def look_alike(network: str, settings: dict[str, Any]) -> dict[str, Tensor]:
    """The state dict of a network as its authors' training may have left it."""
    settings = {"batch_statistics": True} | settings if "batch_statistics" not in settings else settings
    known = inspect.signature(MODELS[network]).parameters
    state = build(network, **{key: value for key, value in settings.items() if key in known}).state_dict()
    state = fill(state, 1.0)
    return {key: value + 3 if key.endswith("num_batches_tracked") else value for key, value in state.items()}


def write_published(folder: Path, network: str, state: Mapping[str, Tensor]) -> list[Path]:
    """Files as the network's authors write them."""
    folder.mkdir(exist_ok=True)
    if network == "sdnet":
        content = {
            "epoch": 173,
            "arch": "ocrnet.HRNet_Mscale",
            "num_classes": 19,
            "state_dict": OrderedDict((f"module.{key}", value) for key, value in state.items()),
            "optimizer": {"state": {0: {"momentum_buffer": torch.zeros(3)}}, "param_groups": [{"lr": 0.01}]},
            "mean_iu": np.nanmean([0.7, 0.9]),
            "command": "--dataset cityscapes",
        }
        torch.save(content, folder / "best_checkpoint_ep173.pth", _use_new_zipfile_serialization=False)
        return [folder / "best_checkpoint_ep173.pth"]
    if network != "vid2vid":
        torch.save(OrderedDict(state), folder / "latest_net_G.pth", _use_new_zipfile_serialization=False)
        return [folder / "latest_net_G.pth"]
    scales = sorted({key.partition(".")[0] for key in state})
    for scale in scales:
        own = {key.partition(".")[2]: value for key, value in state.items() if key.partition(".")[0] == scale}
        torch.save(own, folder / f"latest_net_G{scale}.pth", _use_new_zipfile_serialization=False)
    return [folder / f"latest_net_G{scale}.pth" for scale in scales]


@every_small
def test_a_file_of_its_authors_becomes_ours(tmp_path: Path, network: str, settings: dict[str, Any]) -> None:
    theirs = look_alike(network, settings)
    files = write_published(tmp_path / "theirs", network, theirs)
    found, state = import_published(files, network)
    plain = json.loads(json.dumps(found))
    assert {key: plain[key] for key in settings} == settings
    assert list(state) == list(theirs) and all(torch.equal(state[key], theirs[key]) for key in theirs)
    build(network, **found).load_state_dict(state)


def test_imported_networks_answer_as_in_training_where_they_were_published_so(tmp_path: Path) -> None:
    """The published test programs of vid2vid and Pix2Pix leave norms in training mode."""
    inputs = {"pix2pix": (torch.randn(1, 5, 256, 256),), "vid2vid-single": (torch.rand(1, 35, 64, 64),)}
    for network, given in inputs.items():
        theirs = look_alike(network, SMALL[network][0])
        (file,) = write_published(tmp_path / network, network, theirs)
        settings, state = import_published(file, network)
        ours = build(network, **settings).eval()
        ours.load_state_dict(state)
        settings["batch_statistics"] = False
        training = build(network, **settings, **({"dropout": 0.0} if network == "pix2pix" else {})).train()
        training.load_state_dict(state)
        with torch.no_grad():
            torch.testing.assert_close(ours(*given), training(*given), atol=1e-4, rtol=1e-4)
            assert (training.eval()(*given) - ours(*given)).abs().max() > 1e-2


def test_the_score_in_a_snapshot_of_sdnet_is_passed_over(tmp_path: Path) -> None:
    """It is a number of numpy's, which torch's restricted reader refuses."""
    (file,) = write_published(tmp_path, "sdnet", look_alike("sdnet", SMALL["sdnet"][0]))
    with pytest.raises(pickle.UnpicklingError):
        torch.load(file, weights_only=True)
    import_published(file, "sdnet")
    old = file.read_bytes().replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    assert old != file.read_bytes()
    file.write_bytes(old)  # as numpy 1 wrote it
    import_published(file, "sdnet")


# --- vid2vid's scales -----------------------------------------------------------------------------------------------


@pytest.fixture
def scales(tmp_path: Path) -> list[Path]:
    """The three files of a generator."""
    return write_published(tmp_path / "label2city", "vid2vid", look_alike("vid2vid", SMALL["vid2vid"][0]))


def test_scales_in_any_order_and_by_folder(scales: list[Path]) -> None:
    first = import_published(scales, "vid2vid")
    for files in (scales[::-1], [scales[1], scales[2], scales[0]], [scales[0].parent], scales[0].parent):
        again = import_published(files, "vid2vid")
        assert again.settings == first.settings
        assert all(torch.equal(again.state[key], first.state[key]) for key in first.state)
    (scales[0].parent / "latest_net_D.pth").write_bytes(b"the critic's")
    (scales[0].parent / "10_net_G0.pth").write_bytes(b"of an earlier epoch")
    assert import_published(scales[0].parent, "vid2vid").settings == first.settings


def test_a_coarser_generator_is_one_too(scales: list[Path]) -> None:
    settings, _ = import_published(scales[:2], "vid2vid")
    assert settings["widths"] == [8, 4]


@pytest.mark.parametrize(
    ("chosen", "says"),
    [
        ([1, 2], "0 of the files are the coarsest scale's"),
        ([0, 0, 1], "2 of the files are the coarsest scale's"),
        ([0, 2], "widths [8, 2]: each must be half of the one before it"),
        ([0, 1, 1], "widths [8, 4, 4]: each must be half of the one before it"),
    ],
)
def test_scales_that_do_not_belong_together(scales: list[Path], chosen: list[int], says: str) -> None:
    with pytest.raises(InputError) as caught:
        import_published([scales[place] for place in chosen], "vid2vid")
    assert says in str(caught.value) and str(scales[chosen[0]]) in str(caught.value)


def test_folders_that_do_not_say_which(tmp_path: Path, scales: list[Path]) -> None:
    with pytest.raises(InputError, match=r"holds no \*_net_G0.pth; name the files"):
        import_published(tmp_path, "vid2vid")
    for path in scales:
        path.rename(path.with_name(path.name.replace("latest", "10")))
    assert import_published(scales[0].parent, "vid2vid").settings["widths"] == [8, 4, 2]
    (scales[0].parent / "20_net_G0.pth").write_bytes(b"of another epoch")
    with pytest.raises(InputError, match=r"holds generators of several epochs \(10, 20\)"):
        import_published(scales[0].parent, "vid2vid")
    with pytest.raises(InputError, match="'pix2pix' is published as one file; name that one"):
        import_published(scales, "pix2pix")


def test_a_foreground_that_cannot_be_known_is_refused(tmp_path: Path) -> None:
    settings = {"channels": 16, "widths": [4], "downsamplings": 2, "blocks": [2, 0], "foreground": [1]}
    files = write_published(tmp_path, "vid2vid", look_alike("vid2vid", settings))
    with pytest.raises(InputError, match="paints some of its 16 label channels apart and does not say which"):
        import_published(files, "vid2vid")


# --- files of older torch -------------------------------------------------------------------------------------------

OLD = ["vid2vid", "vid2vid-single", "vid2vid-image-critic", "pix2pix", "pix2pix-critic"]


def without_counters(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {key: value for key, value in state.items() if not key.endswith("num_batches_tracked")}


@pytest.mark.parametrize("network", OLD)
def test_counters_of_batches_may_be_absent_altogether(tmp_path: Path, network: str) -> None:
    theirs = look_alike(network, SMALL[network][0])
    old = without_counters(theirs)
    assert len(old) < len(theirs)
    found = import_published(write_published(tmp_path, network, old), network)
    assert found.state.keys() == theirs.keys()
    assert all(torch.equal(found.state[key], value) for key, value in old.items())
    assert all(not found.state[key].any() for key in theirs.keys() - old.keys())


@pytest.mark.parametrize(
    ("network", "gone"),
    [
        ("pix2pix", ["{counter}"]),  # one of many
        ("pix2pix", ["{mean}"]),
        ("pix2pix", ["model.model.3.bias"]),
        ("sdnet", ["num_batches_tracked"]),  # its torch always wrote them
    ],
)
def test_nothing_else_may_be_absent(tmp_path: Path, network: str, gone: list[str]) -> None:
    theirs = look_alike(network, SMALL[network][0])
    places = {
        "counter": next((key for key in theirs if key.endswith("num_batches_tracked")), ""),
        "mean": next((key for key in theirs if key.endswith("running_mean")), ""),
    }
    endings = tuple(name.format(**places) for name in gone)
    left = {key: value for key, value in theirs.items() if not key.endswith(endings)}
    assert len(left) < len(theirs)
    with pytest.raises(InputError, match=r"tensors are missing, the first is"):
        import_published(write_published(tmp_path, network, left), network)


@pytest.mark.parametrize("counters", [False, True])
def test_statistics_that_old_instance_norms_never_used_are_left_out(tmp_path: Path, counters: bool) -> None:
    theirs = look_alike("pix2pix-critic", SMALL["pix2pix-critic"][1])
    statistics = {"model.3.running_mean": torch.zeros(8), "model.3.running_var": torch.ones(8)}
    if counters:
        statistics["model.3.num_batches_tracked"] = torch.tensor(7)
    found = import_published(write_published(tmp_path, "pix2pix-critic", theirs | statistics), "pix2pix-critic")
    assert found.state.keys() == theirs.keys() and found.settings["norm"] == "instance"
    for strange in ("model.3.weight", "model.2.running_mean", "model.5.running_mean"):
        files = write_published(tmp_path, "pix2pix-critic", theirs | {strange: torch.zeros(8)})
        with pytest.raises(InputError, match="1 tensors are unexpected"):
            import_published(files, "pix2pix-critic")


# --- files that are something else ----------------------------------------------------------------------------------


@every_small
def test_every_key_must_be_used_up(tmp_path: Path, network: str, settings: dict[str, Any]) -> None:
    theirs = look_alike(network, settings)
    if network == "vid2vid":
        theirs["0.head.weight"] = torch.zeros(1)
    else:
        theirs["head.weight"] = torch.zeros(1)
    with pytest.raises(InputError, match=r"1 tensors are unexpected, the first is '(0\.)?head.weight'"):
        import_published(write_published(tmp_path, network, theirs), network)


@pytest.mark.parametrize("expected", [network for network in PUBLISHED if network != "salsanext"])
@pytest.mark.parametrize("given", ["sdnet", "vid2vid-single", "pix2pix", "pix2pix-critic", "vid2vid-image-critic"])
def test_weights_of_another_network(tmp_path: Path, given: str, expected: str) -> None:
    if expected == given or "critic" in expected and given == "vid2vid-image-critic" and expected.startswith("vid2vid"):
        return  # the critics of pictures and clips differ in nothing but what they are shown
    (file,) = write_published(tmp_path, given, look_alike(given, SMALL[given][0]))
    with pytest.raises(InputError) as caught:
        import_published(file, expected)
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("network", ["sdnet", "vid2vid", "vid2vid-single", "pix2pix", "vid2vid-image-critic"])
def test_hostile_and_broken_files_of_every_form(tmp_path: Path, network: str) -> None:
    theirs = look_alike(network, SMALL[network][0])
    files = write_published(tmp_path, network, theirs)
    whole = files[-1].read_bytes()
    files[-1].write_bytes(whole[:-100])
    with pytest.raises(InputError, match="cannot be read as weights"):
        import_published(files, network)
    bad = Hostile(exec, f"__import__('pathlib').Path({str(tmp_path / 'marker')!r}).touch()")
    content = {"state_dict": theirs, "mean_iu": bad}
    torch.save(content, files[-1])
    with pytest.raises(InputError, match="cannot be read as weights"):
        import_published(files, network)
    assert not (tmp_path / "marker").exists()


def test_shapes_that_no_network_has(tmp_path: Path) -> None:
    theirs = look_alike("pix2pix-critic", SMALL["pix2pix-critic"][0])
    for bad in (torch.zeros(2), torch.zeros(0, 9, 4, 4), torch.zeros((1,) * 12)):
        files = write_published(tmp_path, "pix2pix-critic", theirs | {"model.0.weight": bad})
        with pytest.raises(InputError) as caught:
            import_published(files, "pix2pix-critic")
        assert str(files[0]) in str(caught.value)


# --- from the file to the answer ------------------------------------------------------------------------------------


@pytest.mark.parametrize("network", [*SMALL, "titan"])
def test_an_imported_file_is_a_weight_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, network: str
) -> None:
    monkeypatch.chdir(tmp_path)
    settings = SMALL[network][0] if network in SMALL else {}
    theirs = look_alike(network, settings)
    files = [file.relative_to(tmp_path) for file in write_published(tmp_path / "theirs", network, theirs)]
    assert main(["weights", "import", *map(str, files), "--as", network]) == 0
    model, card = load(tmp_path / f"{network}.safetensors", expect=network)
    state = model.state_dict()
    assert all(torch.equal(state[key], theirs[key]) for key in theirs) and state.keys() == theirs.keys()
    assert card.upstream.startswith("https://github.com/") and card.licence in capsys.readouterr().out
    assert card.recipe == f"published ({', '.join(file.name for file in files)})"
    assert card.normalisation.keys() == {"mean", "deviation"}
    assert bool(card.views) == (network in ("titan", "pix2pix"))
    assert json.loads(json.dumps(card.settings)).items() >= settings.items()


def test_licences_that_restrict_are_recognised(tmp_path: Path) -> None:
    for network, restricted in {"sdnet": True, "vid2vid": True, "pix2pix": False, "titan": True}.items():
        model = build(network, **(SMALL[network][0] if network in SMALL else {}))
        card = published_card(network, "file", SMALL[network][0] if network in SMALL else {})
        save(tmp_path / f"{network}.safetensors", model, card)
        assert bool(licence_note([read_card(tmp_path / f"{network}.safetensors")])) == restricted


def test_an_imported_sdnet_labels_images(tmp_path: Path) -> None:
    theirs = look_alike("sdnet", SMALL["sdnet"][0])
    (file,) = write_published(tmp_path, "sdnet", theirs)
    settings, state = import_published(file, "sdnet")
    network = build("sdnet", **settings)
    network.load_state_dict(state)
    card = published_card("sdnet", file.name, settings)
    answer = CameraSegmenter.from_card(network.eval(), card).probabilities(np.zeros((40, 50, 3), np.uint8))
    assert answer.shape == (19, 40, 50)


def test_weights_that_are_not_finite_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    theirs = look_alike("pix2pix-critic", SMALL["pix2pix-critic"][0])
    theirs["model.0.bias"][0] = torch.nan
    files = write_published(tmp_path, "pix2pix-critic", theirs)
    assert main(["weights", "import", str(files[0]), "--as", "pix2pix-critic"]) == 2
    assert "'model.0.bias' has values that are not finite" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.safetensors"))


@pytest.mark.parametrize(("inputs", "outputs", "labels"), [(25, 15, "common-14"), (5, 3, None), (3, 3, None)])
def test_a_pix2pix_that_reads_the_range_view_says_which(inputs, outputs, labels):
    card = published_card("pix2pix", "latest_net_G.pth", {"inputs": inputs, "outputs": outputs})
    assert card.labels == labels
    if inputs == 3:
        assert not card.views and "size" not in card.settings
    else:
        assert View(**card.views["input"]) == VIEWS["titan-front"] and card.settings["size"] == (376, 1241)
        assert card.normalisation == published_card("titan", "x", {}).normalisation
        assert role(card) == ("translator" if labels else "renderer")
