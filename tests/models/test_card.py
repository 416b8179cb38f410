"""Weight files: what `save` writes, `load` reads; everything else is refused in one line."""

from __future__ import annotations

import hashlib
import io
import json
import os
import stat
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from lidar2pano.errors import InputError
from lidar2pano.formats import torch_files
from lidar2pano.models import build, card
from lidar2pano.models.card import Card, load, read_card, save, write_scores

FULL = Card(
    network="titan-critic",
    settings={"image_channels": 3, "conditions": 4, "width": 2},
    labels="common-15",
    views={"image": {"rows": 64, "columns": 2048, "up": 3.0, "down": -25.0}},
    normalisation={"mean": [12.12, 10.88, 0.23, -1.04, 0.21], "std": [12.32, 11.47, 6.91, 0.86, 0.16]},
    recipe="titan",
    commit="0123abc",
    data="semantic-kitti 00-07",
    steps=1000,
    device="CPU",
    hours=1.5,
    score={"split": "08", "miou": 0.5},
    licence="CC BY-NC-SA 4.0",
    upstream="https://example.org",
)


def _written(path: Path, **changes: object) -> tuple[torch.nn.Module, Card]:
    made = replace(FULL, **changes)
    model = build(made.network, **made.settings)
    return model, save(path, model, made)


def _tampered(path: Path, text: str | None = None, **tensors: torch.Tensor | None) -> None:
    """Write `path` again with another card or other tensors (None removes one), as anybody's tool could."""
    with safe_open(path, "pt") as file:
        metadata = file.metadata()
    kept = load_file(path) | tensors
    metadata = metadata if text is None else {"card": text}
    save_file({key: tensor for key, tensor in kept.items() if tensor is not None}, path, metadata=metadata)


def _with(path: Path, **fields: object) -> str:
    return json.dumps(json.loads(read_card(path).to_json()) | fields)


def _assert_refused(path: Path, says: str, **how: str) -> None:
    with pytest.raises(InputError) as caught:
        load(path, **how)
    assert says in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_float32_weights_come_back_exactly_with_their_card(tmp_path: Path) -> None:
    model = build(FULL.network, **FULL.settings)
    written = save(tmp_path / "weights.safetensors", model, FULL, torch.float32)
    again, read = load(tmp_path / "weights.safetensors", expect="titan-critic")
    assert replace(written, sha256="") == FULL
    assert read == written == read_card(tmp_path / "weights.safetensors")
    assert len(read.sha256) == 64
    assert not again.training
    assert all(torch.equal(again.state_dict()[key], value) for key, value in model.state_dict().items())


def test_float16_halves_matrices_and_leaves_vectors_and_counters_alone(tmp_path: Path) -> None:
    model = build("salsanext", classes=3)
    model.downCntx.bn1.running_var.fill_(1e-9)  # float16 would make it 0
    model.downCntx.bn2.running_var.fill_(1e6)  # and this infinite
    model.downCntx.bn1.num_batches_tracked.fill_(100_000)
    model.logits.weight.data[0, 0] = 1e5
    save(tmp_path / "weights", model, Card(network="salsanext", settings={"classes": 3}))
    kept, (again, _) = load_file(tmp_path / "weights"), load(tmp_path / "weights")
    types = {key: tensor.dtype for key, tensor in kept.items()}
    assert types["downCntx.conv1.weight"] == torch.float16
    assert types["downCntx.conv1.bias"] == types["downCntx.bn1.running_var"] == torch.float32
    assert types["logits.weight"] == torch.float32  # it does not fit into float16
    assert types["downCntx.bn1.num_batches_tracked"] == torch.int64
    for key, value in model.state_dict().items():
        assert again.state_dict()[key].dtype == value.dtype, key
        torch.testing.assert_close(again.state_dict()[key], value, rtol=1e-3, atol=1e-6)
    for buffer in ("bn1.running_var", "bn2.running_var", "bn1.num_batches_tracked"):
        assert torch.equal(again.downCntx.get_buffer(buffer), model.downCntx.get_buffer(buffer))


def test_settings_that_are_tuples_come_back_as_their_json(tmp_path: Path) -> None:
    made = Card(network="titan", settings={"size": (24, 40)})
    written = save(tmp_path / "weights", build("titan", size=(24, 40)), made)
    model, read = load(tmp_path / "weights")
    assert read == written
    assert model.size == (24, 40)


def test_save_makes_the_folder_and_a_file_that_others_may_read(tmp_path: Path) -> None:
    path = tmp_path / "runs" / "today" / "weights"
    _written(path)
    (tmp_path / "plain").touch()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


@pytest.mark.parametrize("fails", ["write", "rename"])
def test_a_failing_save_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    path = tmp_path / "weights"
    _written(path)
    before = path.read_bytes()

    def broken(self: Path, *_: object) -> None:
        if fails == "write":
            self.touch()
        raise OSError("no space left on device")

    monkeypatch.setattr(Path, "write_bytes" if fails == "write" else "replace", broken)
    with pytest.raises(InputError, match="no space"):
        _written(path)
    assert [one.name for one in tmp_path.iterdir()] == ["weights"]
    assert path.read_bytes() == before


def test_save_refuses_what_load_would_refuse(tmp_path: Path) -> None:
    model = build(FULL.network, **FULL.settings)
    with pytest.raises(ValueError, match=r"does not describe the model.*has shape"):
        save(tmp_path / "weights", model, replace(FULL, settings={"image_channels": 4, "conditions": 4, "width": 2}))
    with pytest.raises(ValueError, match="float16 or float32"):
        save(tmp_path / "weights", model, FULL, torch.bfloat16)
    with pytest.raises(ValueError, match="JSON compliant"):
        save(tmp_path / "weights", model, replace(FULL, score={"miou": float("nan")}))
    model.conv1[0].bias.data[3] = float("nan")
    with pytest.raises(ValueError, match=r"'conv1.0.bias' has values that are not finite"):
        save(tmp_path / "weights", model, FULL)
    assert list(tmp_path.iterdir()) == []


def test_files_that_are_no_weight_files(tmp_path: Path) -> None:
    path = tmp_path / "weights"
    _assert_refused(path, "no weight file")
    _assert_refused(tmp_path, "no weight file")
    _written(path)
    whole = path.read_bytes()
    for cut in (0, 7, 100, len(whole) - 1):
        path.write_bytes(whole[:cut])
        _assert_refused(path, "cut off or not a weight file")
    torch.save({"a": torch.zeros(2)}, path)
    _assert_refused(path, "cut off or not a weight file")
    save_file({"a": torch.zeros(2)}, path)
    _assert_refused(path, "has no card")


def test_a_sparse_file_is_not_read(tmp_path: Path) -> None:
    path, size = tmp_path / "weights", 1 << 30
    head = json.dumps({"a": {"dtype": "U8", "shape": [size], "data_offsets": [0, size]}}).encode()
    path.write_bytes(len(head).to_bytes(8, "little") + head)
    os.truncate(path, 8 + len(head) + size)
    _assert_refused(path, "are stored")


def test_a_file_that_is_cut_while_it_is_read_ends_no_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A mapped one would, by SIGBUS: the file is cut when its header has been read."""
    path = tmp_path / "weights"
    _written(path)
    texts = torch_files._texts

    def cut(file: io.FileIO) -> dict[str, object]:
        found = texts(file)
        os.truncate(path, 5000)
        return found

    monkeypatch.setattr(torch_files, "_texts", cut)
    _assert_refused(path, "cut off or not a weight file")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "its card: is no JSON"),
        ('{"network": "titan", "hours": NaN}', "its card: is no JSON (NaN"),
        ("[" * 100_000, "its card: is no JSON"),
        ('["titan"]', "its card: it must be an object"),
        ("{}", "it has no 'network'"),
        ('{"network": "titan", "recipes": ""}', "unknown field 'recipes'; did you mean 'recipe'?"),
        ('{"network": ["titan"]}', "its 'network' must be a text"),
        ('{"network": "titan", "settings": []}', "its 'settings' must be an object"),
        ('{"network": "titan", "labels": 15}', "its 'labels' must be a text or null"),
        ('{"network": "titan", "hours": "2"}', "its 'hours' must be a number"),
        ('{"network": "titann"}', "no network 'titann'; did you mean 'titan'?"),
        ('{"network": "titan", "settings": {"n_classes": 3}}', "no setting 'n_classes'; did you mean 'classes'?"),
        ('{"network": "titan", "settings": {"classes": "x"}}', "cannot be built with settings {'classes': 'x'}"),
        ('{"network": "titan", "settings": {"size": ["a\\n", 2]}}', "cannot be built with settings"),
        ('{"network": "salsanext", "settings": {"classes": 4000000000}}', "does not fit network 'salsanext'"),
    ],
)
def test_wrong_cards(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "weights"
    _written(path)
    _tampered(path, text)
    _assert_refused(path, says)


def test_tensors_that_do_not_fit_the_card(tmp_path: Path) -> None:
    path = tmp_path / "weights"
    _written(path)
    bias = load_file(path)["conv1.0.bias"]
    for value, says in {
        None: "1 tensors are missing, the first is 'conv1.0.bias'",
        bias[:-1].clone(): "'conv1.0.bias' has shape [29], expected [30]",
        bias.double(): "'conv1.0.bias' is of type torch.float64",
        bias.int(): "'conv1.0.bias' is of type torch.int32",
    }.items():
        _tampered(path, **{"conv1.0.bias": value})
        _assert_refused(path, says)
    _tampered(path, **{"conv1.0.bias": bias, "head": torch.zeros(1)})
    _assert_refused(path, "1 tensors are unexpected, the first is 'head'")
    _tampered(path, head=None)
    load(path)


def test_changed_tensors_are_noticed(tmp_path: Path) -> None:
    path = tmp_path / "weights"
    _written(path)
    damaged = bytearray(path.read_bytes())
    damaged[-1] ^= 1
    path.write_bytes(damaged)
    _assert_refused(path, "its checksum is wrong")

    _written(path)
    kept = load_file(path)
    first, last = [key for key, tensor in kept.items() if list(tensor.shape) == [30]][:2]
    _tampered(path, **{first: kept[last], last: kept[first]})  # the same bytes under other names
    _assert_refused(path, "its checksum is wrong")

    _written(path)
    _tampered(path, _with(path, sha256=""))
    _assert_refused(path, "its checksum is wrong")


def test_the_checksum_is_the_documented_one(tmp_path: Path) -> None:
    written = _written(tmp_path / "weights")[1]
    digest = hashlib.sha256()
    for key, tensor in sorted(load_file(tmp_path / "weights").items()):
        digest.update(f"{key} {tensor.dtype} {list(tensor.shape)}\n".encode() + tensor.numpy().tobytes())
    assert written.sha256 == digest.hexdigest()


def test_a_card_alone_can_be_changed_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "weights"
    _written(path)
    _tampered(path, _with(path, licence="CC0"))
    assert load(path)[1].licence == "CC0"


def test_weights_of_another_network_are_named(tmp_path: Path) -> None:
    path = tmp_path / "weights"
    _written(path)
    _assert_refused(path, "has weights of another network: 'titan-critic' instead of 'salsanext'", expect="salsanext")


def test_a_card_cannot_make_the_network_fill_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, built = tmp_path / "weights", []
    _written(path)
    monkeypatch.setattr(card, "build", lambda *a, **k: built.append(torch.get_default_device()) or build(*a, **k))
    _tampered(path, _with(path, settings={"image_channels": 10**9, "conditions": 4, "width": 2}))
    _assert_refused(path, "has shape")
    assert built == [torch.device("meta")]


def test_a_network_is_built_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, built = tmp_path / "weights", []
    _written(path)
    monkeypatch.setattr(card, "build", lambda *a, **k: built.append(torch.get_default_device()) or build(*a, **k))
    network, _ = card.load(path)
    assert built == [torch.device("meta")]
    before = {key: tensor.clone() for key, tensor in network.state_dict().items()}
    assert not any(tensor.is_meta for tensor in (*before.values(), *network.buffers()))
    assert {tensor.dtype for tensor in before.values() if tensor.is_floating_point()} == {torch.float32}
    path.write_bytes(bytes(path.stat().st_size))  # in place: the network's tensors are not those of the file
    assert all(torch.equal(tensor, before[key]) for key, tensor in network.state_dict().items())


def test_scores_beside_a_file_are_those_of_its_tensors(tmp_path: Path) -> None:
    _, written = _written(tmp_path / "weights.safetensors")
    _, other = _written(tmp_path / "other.safetensors", score={})
    before = (tmp_path / "weights.safetensors").read_bytes()
    write_scores(tmp_path, [replace(written, score={"split": "09", "miou": 0.6})])
    assert (tmp_path / "weights.safetensors").read_bytes() == before
    assert json.loads((tmp_path / "scores.json").read_text()) == {
        "scores": {written.sha256: {"split": "09", "miou": 0.6}}
    }
    measured = replace(written, score={"split": "09", "miou": 0.6})
    assert read_card(tmp_path / "weights.safetensors") == load(tmp_path / "weights.safetensors")[1] == measured
    assert other.sha256 != written.sha256 and read_card(tmp_path / "other.safetensors").score == {}


@pytest.mark.parametrize("text", ["{", "[]", '{"scores": {"a": 1}}', '{"scores": {}, "more": 1}', "{}"])
def test_broken_scores_beside_a_file_are_refused_in_one_line(tmp_path: Path, text: str) -> None:
    _written(tmp_path / "weights.safetensors")
    (tmp_path / "scores.json").write_text(text)
    with pytest.raises(InputError, match=r"scores\.json.*remove it") as caught:
        read_card(tmp_path / "weights.safetensors")
    assert "\n" not in str(caught.value)
