"""Every command of docs/semantic_kitti.md, as it stands there, on 22 small sequences with small networks."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import house_rules
from lidar2pano.cli import main
from lidar2pano.models import build
from lidar2pano.train.recipe import Recipe, override
from lidar2pano.train.recipes import RECIPES, recipe_named
from lidar2pano.views import VIEWS
from miniature_images import write_cityscapes
from semantic_kitti import write_semantic_kitti
from small_recipes import FRONT, VIEW, small

PAGE = (house_rules.ROOT / "docs" / "semantic_kitti.md").read_text(encoding="utf-8")
SMALL_SDNET = {"width": 4, "stem": 8, "blocks": 1, "modules": (1, 1, 1), "context": 8}
SMALL_VIDEO = {"channels": 16, "widths": (4,), "downsamplings": 1, "blocks": (2, 1), "foreground": ()}
FURTHER = {"reproduce": ["--rows", "titan", "--frames", "2"]}  # one row of twelve


def checkpoints(folder: Path) -> None:
    """Files as the authors publish them, of small or untrained networks."""
    networks = {
        "SalsaNext": build("salsanext", classes=20, channels=5),
        "titan.pth": build("titan"),
        "sdnet.pth": build("sdnet", classes=19, scales=(0.5, 1.0), **SMALL_SDNET),
    }
    for name, weight in networks["sdnet.pth"].named_parameters():
        if name.endswith("bias") and weight.shape == (19,):
            weight.data[2] = 20.0  # sure of buildings, everywhere
    for name, network in networks.items():
        weights = {f"module.{key}": value for key, value in network.state_dict().items()}
        torch.save({"state_dict": weights}, folder / name)
    (folder / "vid2vid").mkdir()
    table = build("vid2vid", **SMALL_VIDEO | {"channels": 36}, batch_statistics=True).state_dict()
    torch.save(
        {key.removeprefix("0."): value for key, value in table.items()}, folder / "vid2vid" / "latest_net_G0.pth"
    )


def changed(recipe: Recipe, *changes: str, **settings: dict) -> Recipe:
    networks = {
        role: replace(network, settings={**network.settings, **settings.get(role, {})})
        for role, network in recipe.networks.items()
    }
    recipe = replace(recipe, networks=networks)
    for change in ("training.steps=1", "training.batch=1", "training.workers=0", *changes):
        recipe = override(recipe, change)
    return recipe


def recipes() -> dict[str, Recipe]:
    """The recipes that the page trains, with small networks and one step; protocol and options are the page's."""
    titan = small("titan-mini", "options.segments=predicted")
    sdnet = changed(
        recipe_named("sdnet-mini"), "options.rows=64", "options.columns=128", "training.batch=2", camera=SMALL_SDNET
    )
    narrow = {"critic": {"width": 4}, "temporal_1": {"width": 4}, "temporal_3": {"width": 4}}
    video = changed(
        recipe_named("vid2vid"), "options.clip_length=9", "options.rows=32", "options.columns=64", "scale=1",
        painter=SMALL_VIDEO, **narrow,
    )  # fmt: skip
    return {"titan": titan, "sdnet": sdnet, "vid2vid": replace(video, training=replace(video.training, epochs=0))}


@pytest.fixture
def tree(tmp_path, monkeypatch) -> Path:
    """A folder with what the page has downloaded; networks and rasters are small."""
    for name, view in {"hdl64e": replace(VIEWS["hdl64e"], rows=16, columns=128), "titan-front": FRONT, **VIEW}.items():
        monkeypatch.setitem(VIEWS, name, view)
    for name, recipe in recipes().items():
        monkeypatch.setitem(RECIPES, name, lambda recipe=recipe: recipe)
    monkeypatch.setattr("lidar2pano.metrics.sliced_wasserstein.DIRECTIONS", 4)  # of 128: seconds are what is saved
    write_semantic_kitti(tmp_path / "KITTI", camera_labels=False, scale=0.15)
    write_cityscapes(tmp_path / "CITYSCAPES")
    checkpoints(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_command_of_the_page_works(tree, capsys):
    lines = "".join(re.findall(r"^```sh\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)).splitlines()
    commands = [shlex.split(line)[1:] for line in lines]
    assert {words[0] for words in commands} == {"weights", "prepare", "evaluate", "translate", "train", "reproduce"}
    for words in commands:
        device = [] if words[0] == "weights" else ["--device", "cpu"]
        if words[:3] == ["prepare", "KITTI", "--lidar"] and "runs/camera" in words:
            for labels in (tree / "KITTI").glob("sequences/*/camera_labels/*.png"):
                labels.unlink()  # of the way with SD-Net's weights
        code = main([*words, *FURTHER.get(words[0], []), *device])
        assert code == 0, (words, capsys.readouterr().err[-2000:])
        said = capsys.readouterr().out
        if words[0] == "evaluate":
            assert "Pseudo-labels of networks" in said and "(pseudo-labels by " in said
            assert "Weights were selected on this split" not in said
    assert (tree / "published.csv").is_file()
    for name in ("panoramas/000000.png", "panoramas/000000.segments.png", "ours/000000.png"):
        assert (tree / name).is_file()
    text = (tree / "tables" / "RESULTS.md").read_text()
    assert "TITAN-Net -> Vid2Vid" in text and "SD-Net (in training only)" in text and "**confirmed" not in text
    assert (tree / "tables" / "images" / "titan" / "00.panorama.png").is_file()
    for sequence in range(22):
        folder = tree / "KITTI" / "sequences" / f"{sequence:02d}"
        assert (folder / "predicted_labels" / "000000.label").is_file() and (folder / "camera_labels").is_dir()
