"""nuScenes and KITTI-360 as training sets: segmenter, translator and painter train and are evaluated on them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from lidar2pano.data.layouts import frames
from lidar2pano.errors import InputError
from lidar2pano.evaluate import report, score, system
from lidar2pano.evaluate.evaluation import Evaluation
from lidar2pano.models import build
from lidar2pano.models.card import Card, save
from lidar2pano.models.families import weight_files
from lidar2pano.train.engine import train
from lidar2pano.train.recipe import Recipe, override
from lidar2pano.train.recipes import recipe_named
from lidar2pano.train.tasks import build_task
from lidar2pano.views import VIEWS
from miniature_layouts import write_kitti360_layout, write_nuscenes_layout
from random_weights import PAINTER

PLAIN = ["training.steps=2", "training.batch=2", "training.workers=0", "training.precision=32-true"]
MINI = ["data.train=mini_train", "data.val=mini_val"]
EIGHTH = VIEWS["panorama"].scaled(1 / 8)
SETTINGS = {
    "segmenter": {},
    "translator": {"classes": 16, "conditions": 20, "widths": (8, 8, 8, 8, 8), "pyramid": 8},
    "painter": PAINTER,
}


@pytest.fixture(scope="module")
def nuscenes_root(tmp_path_factory) -> Path:
    return write_nuscenes_layout(tmp_path_factory.mktemp("nuscenes"))


@pytest.fixture(scope="module")
def kitti360_root(tmp_path_factory) -> Path:
    return write_kitti360_layout(tmp_path_factory.mktemp("kitti360"))


@pytest.fixture(scope="module")
def fisheye_root(tmp_path_factory) -> Path:
    return write_kitti360_layout(tmp_path_factory.mktemp("fisheyes"), fisheyes=True)


def small(name: str, *assignments: str) -> Recipe:
    """A released recipe with networks small enough for a test; two steps."""
    recipe = recipe_named(name)
    networks = {
        role: replace(
            network, settings={**network.settings, **SETTINGS[role]} if role == "segmenter" else SETTINGS[role]
        )
        for role, network in recipe.networks.items()
    }
    recipe = replace(recipe, networks=networks)
    for assignment in [*PLAIN, *assignments]:
        recipe = override(recipe, assignment)
    return recipe


@pytest.fixture(scope="module")
def segmenter(nuscenes_root, tmp_path_factory) -> Path:
    """Weights of a segmenter that was trained on nuScenes for two steps."""
    out = tmp_path_factory.mktemp("segmenter")
    train(small("salsanext-mini", *MINI, "view=nuscenes", "options.columns=64"), nuscenes_root, out, device="cpu")
    return weight_files(out)["segmenter"]


@pytest.fixture(scope="module")
def latents(tmp_path_factory) -> str:
    """An untrained autoencoder, as an option."""
    file = tmp_path_factory.mktemp("latents") / "autoencoder.safetensors"
    settings = {"latents": 4, "encoder": (4, 6, 8), "decoder": (4, 4, 6, 8)}
    save(file, build("autoencoder", **settings), Card(network="autoencoder", settings=settings))
    return f"options.autoencoder={file}"


def evaluated(weights: Path, segmenter: Path, root: Path, split: str) -> Evaluation:
    chain = f"{segmenter.parents[1]}+{weights}"
    scored = frames(root, split, EIGHTH)[:1]
    return score([system(chain, device="cpu")], scored, data=root.name, split=split)


def test_nuscenes_trains_a_translator_from_every_direction(nuscenes_root, segmenter, tmp_path):
    options = ["scale=0.125", "options.columns=64"]
    train(small("titan-pano-mini", *MINI, *options), nuscenes_root, tmp_path / "run", device="cpu")
    records = report.records(report.as_dict(evaluated(tmp_path / "run", segmenter, nuscenes_root, "mini_val")))
    named = {(record["sector"], record["metric"]): record["value"] for record in records}
    assert any(sector == "panorama" for sector, _ in named) and any("miou" in metric for _, metric in named)


def test_nuscenes_without_lidarseg_says_what_to_download(nuscenes_root, tmp_path):
    (tmp_path / "samples").symlink_to(nuscenes_root / "samples")
    (tmp_path / "v1.0-mini").symlink_to(nuscenes_root / "v1.0-mini")
    for name in ("salsanext-mini", "titan-pano-mini"):
        with pytest.raises(InputError, match="_lidarseg.bin: is missing; download nuScenes-lidarseg"):
            build_task(small(name, *MINI), tmp_path)


def test_kitti_360_trains_a_translator_and_a_painter_on_a_segmenters_labels(
    kitti360_root, segmenter, latents, tmp_path
):
    labels = f"options.segmenter={segmenter}"
    options = ["scale=0.125", "options.columns=64"]
    with pytest.raises(InputError, match="KITTI-360 has no labels of single scans"):
        train(small("titan-pano-mini", *options), kitti360_root, tmp_path / "none", device="cpu")
    train(small("titan-pano-mini", labels, *options), kitti360_root, tmp_path / "translator", device="cpu")
    records = report.records(report.as_dict(evaluated(tmp_path / "translator", segmenter, kitti360_root, "val")))
    named = {(record["sector"], record["metric"]): record["value"] for record in records}
    assert any(sector == "camera" and "miou" in metric for sector, metric in named)
    assert not any(sector == "panorama" for sector, _ in named), "one camera is no panorama"
    translator = f"options.translator={weight_files(tmp_path / 'translator')['translator']}"
    task = build_task(small("latent-painter-mini", labels, translator, latents, *options), kitti360_root)
    sample = task.dataset[0]
    assert sample.coverage.any() and sample.latents.isfinite().all()


def test_kitti_360_with_its_fisheyes_trains_and_is_evaluated_all_around(fisheye_root, segmenter, latents, tmp_path):
    labels = f"options.segmenter={segmenter}"
    options = ["scale=0.125", "options.columns=64"]
    train(small("titan-pano-mini", labels, *options), fisheye_root, tmp_path / "translator", device="cpu")
    weights = weight_files(tmp_path / "translator")["translator"]
    translator = f"options.translator={weights}"
    recipe = small("latent-painter-mini", labels, translator, latents, *options)
    task = build_task(recipe, fisheye_root)
    picture, coverage = task.dataset.photograph(0)
    assert picture.shape[-1] == 2 * EIGHTH.columns and coverage.float().mean() > 0.95, "all around"
    train(recipe, fisheye_root, tmp_path / "painter", device="cpu")
    painter = weight_files(tmp_path / "painter")["painter"]
    chain = f"{segmenter.parents[1]}+{weights}+{painter}"
    scored = frames(fisheye_root, "val", EIGHTH)[:1]
    records = report.records(
        report.as_dict(score([system(chain, device="cpu")], scored, data="kitti-360", split="val"))
    )
    named = {(record["sector"], record["metric"]): record["value"] for record in records}
    assert any(sector == "camera" and "miou" in metric for sector, metric in named)
    assert any(sector == "panorama" and "ssim" in metric for sector, metric in named)
    assert not any(sector == "panorama" and "miou" in metric for sector, metric in named), "no labels all around"
