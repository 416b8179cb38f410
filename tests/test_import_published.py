"""Checkpoint files as the authors' trainers write them, and as nobody should."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch

from lidar2pano.errors import InputError
from lidar2pano.models import build
from lidar2pano.models.published import PUBLISHED, import_published


def test_a_titan_checkpoint_is_a_plain_state_dict(tmp_path: Path) -> None:
    theirs = build("titan").state_dict()
    torch.save({f"module.{key}": value for key, value in theirs.items()}, tmp_path / "training_generator_9.pth")
    ours = import_published(tmp_path / "training_generator_9.pth", "titan")
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
    ours = import_published(tmp_path / "SalsaNext", "salsanext")
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
