"""Every script of runs/ can be imported without doing anything, and explains itself."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import nn

from lidar2pano.models import build
from lidar2pano.models.card import Card, load, save
from lidar2pano.models.circular import conv_norm_act

SUPPORT = Path(__file__).resolve().parents[1] / "support"
RUNS = Path(__file__).resolve().parents[2] / "runs"
SCRIPTS = [path.name for path in sorted(RUNS.glob("*.py"))]
WITH_OPTIONS = [name for name in SCRIPTS if "argparse" in (RUNS / name).read_text(encoding="utf-8")]


@pytest.fixture
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder, and no help from pytest's own path: a script has to find tests/support itself."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if Path(entry).resolve() != SUPPORT])
    for path in SUPPORT.glob("*.py"):
        monkeypatch.delitem(sys.modules, path.stem, raising=False)
    return tmp_path


def test_scripts_are_found() -> None:
    assert len(SCRIPTS) > len(WITH_OPTIONS) > 10


@pytest.mark.parametrize("name", SCRIPTS)
def test_importing_a_script_does_nothing(name: str, alone: Path, capfd: pytest.CaptureFixture[str]) -> None:
    found = runpy.run_path(str(RUNS / name))
    assert callable(found["main"]) and found["__doc__"]
    assert capfd.readouterr() == ("", "")
    assert list(alone.iterdir()) == []


@pytest.mark.parametrize("name", WITH_OPTIONS)
def test_a_script_with_options_explains_them(
    name: str, alone: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [str(RUNS / name), "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(RUNS / name), run_name="__main__")
    assert ended.value.code == 0
    assert name in capsys.readouterr().out


@pytest.mark.parametrize("path", sorted(RUNS.glob("*.sh")), ids=lambda path: path.name)
def test_shell_scripts_parse(path: Path) -> None:
    assert subprocess.run(["bash", "-n", path], capture_output=True, text=True, check=False).stderr == ""


def test_four_convolutions_of_a_shuffle_become_their_mean() -> None:
    torch.manual_seed(0)
    shuffled, merged = nn.Module(), runpy.run_path(str(RUNS / "without_shuffles.py"))["merged"]
    shuffled.up0 = nn.Sequential(conv_norm_act(5, 12, 1), nn.PixelShuffle(2)).eval()
    norm = shuffled.up0[0][1]
    for value in (norm.weight.data, norm.bias.data, norm.running_mean, norm.running_var):
        value.uniform_(0.5, 2)
    enlarged = conv_norm_act(5, 3, 1).eval()
    state = merged(shuffled.state_dict(), "up0")
    enlarged.load_state_dict({name.removeprefix("up0."): value for name, value in state.items()})
    x = torch.randn(1, 5, 4, 6)
    expected = shuffled.up0[0][:2](x).unflatten(1, (3, 4)).mean(2)
    assert torch.allclose(enlarged[:2](x), expected, atol=1e-5)


def test_a_segmenter_that_reads_roughness_begins_as_the_one_before(tmp_path: Path) -> None:
    network, card = build("salsanext", classes=4), Card(network="salsanext", settings={"classes": 4})
    save(tmp_path / "five.safetensors", network, card)
    runpy.run_path(str(RUNS / "with_roughness.py"))["main"](str(tmp_path / "five.safetensors"), str(tmp_path / "six"))
    longer, card = load(tmp_path / "six")
    assert card.settings["channels"] == 6 and len(card.normalisation["mean"]) == 6
    x = torch.randn(1, 6, 16, 16)
    torch.testing.assert_close(longer.eval()(x), network.eval()(x[:, :5]), atol=0.002, rtol=0)
