"""Commands that are killed at random instants: repeated, they give the bytes of an undisturbed run, and leave nothing.

`--kills N` kills each N times (`make kills`). What `bulk` does is tested in tests/bulk, too.
"""

from __future__ import annotations

import json
import random
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import miniature
import miniature_surround
import miniature_video
from lidar2pano.cli.app import INTERRUPTED, TERMINATED
from lidar2pano.models import build
from lidar2pano.models.card import Card, save
from outputs import check_leavings, contents, plain
from random_weights import street, write_camera_teacher, write_data_set, write_scan
from small_recipes import SMALL
from toy_training import gap

ENDS = (0, TERMINATED, INTERRUPTED, -signal.SIGKILL, -signal.SIGTERM)
Run = Callable[..., tuple[int, float, str]]


def after_kills(run: Run, words: Callable[[Path], list[str]], fresh: Callable[[Path], Path], kills: int) -> list[Path]:
    """Folders in which a command was killed so often in all, at random instants, and then repeated to its end."""
    draw, number, folders = random.Random(7), 0, [fresh(Path("killed-0"))]
    code, seconds, said = run(words(fresh(Path("timed"))))
    assert code == 0, said
    while kills:
        sign = draw.choice([signal.SIGKILL, signal.SIGTERM])
        code, taken_s, said = run(words(folders[-1]), draw.uniform(0, seconds), sign)
        assert code in ENDS, said
        if code:
            kills -= 1
        else:
            seconds = min(seconds, taken_s)  # the first run may have been the slowest
            number += 1
            folders.append(fresh(Path(f"killed-{number}")))
    for folder in folders:
        assert run(words(folder))[0] == 0
    return folders


def check(whole: Path, folders: list[Path], without: tuple[str, ...] = ()) -> None:
    expected = contents(whole, without)
    assert expected
    for folder in folders:
        assert contents(folder, without) == expected
        check_leavings(folder)


@pytest.fixture
def here(tmp_path, monkeypatch, random_weights):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small").symlink_to(random_weights)
    return tmp_path


@pytest.fixture
def kills(request) -> int:
    return request.config.getoption("kills")


def absolute(folder: Path) -> Path:
    return folder.absolute()


def test_translate(here, run, kills):
    for number in range(4):
        write_scan(here / "drive" / f"{number:06d}.bin", street(seed=number))

    def words(out: Path) -> list[str]:
        return [
            *("translate", str(here / "drive"), "--weights", str(here / "small"), "--device", "cpu", "--save", "all"),
            *("--ply", "--out", str(out)),
        ]

    folders = after_kills(run, words, absolute, kills)
    check(here / "timed", folders)
    assert len(contents(folders[0])) == 4 * 5


def test_world(here, run, kills):
    def words(out: Path) -> list[str]:
        options = ["--frames", "2", "--save", "scans", "--sensor", "vlp16", "--place", "country", "--processes", "1"]
        return ["world", str(out), *options]

    check(here / "timed", after_kills(run, words, absolute, kills))


def test_prepare(here, run, kills):
    camera = write_camera_teacher(here / "sdnet.safetensors")

    def fresh(folder: Path) -> Path:
        root = write_data_set(folder.absolute(), frames=3, size=(60, 20))
        for path in [file for part in ("labels", "camera_labels") for file in root.glob(f"sequences/00/{part}/*")]:
            path.unlink()
        return root

    def words(root: Path) -> list[str]:
        teachers = ["--lidar", str(here / "small"), "--teacher", str(camera)]
        return ["prepare", str(root), *teachers, "--device", "cpu"]

    folders = after_kills(run, words, fresh, kills)
    check(here / "timed", folders, without=("prepared.jsonl",))
    for part in ("labels", "camera_labels"):
        assert len(list((folders[0] / "sequences" / "00" / part).iterdir())) == 3


def check_runs(whole: Path, folders: list[Path]) -> None:
    for folder in folders:
        assert gap(whole, folder) == 0
        check_leavings(folder)
        assert len(list((folder / "checkpoints").iterdir())) == 1


def test_train(here, run, kills):
    check_runs(here / "timed", after_kills(run, lambda out: ["toy-training", str(out)], absolute, kills))


def plain_data(here: Path) -> tuple[Path, list[str]]:
    """A miniature data set, and changes of a recipe that its data ask for; {out} is the run's folder."""
    return miniature.write_data_set(here / "data"), []


def labelled_data(here: Path) -> tuple[Path, list[str]]:
    return miniature.write_data_set(here / "data"), ["options.columns=64", "data.train=train"]


def camera_data(here: Path) -> tuple[Path, list[str]]:
    return miniature.write_data_set(here / "data"), ["options.rows=32", "options.columns=48", "training.batch=2"]


def panorama_data(here: Path) -> tuple[Path, list[str]]:
    changes = ["scale=0.125", "options.columns=160", f"options.segmenter={here / 'small/segmenter.safetensors'}"]
    return miniature.write_data_set(here / "data"), changes


def translated(here: Path) -> list[str]:
    return [f"options.{role}={here / 'small' / role}.safetensors" for role in ("segmenter", "translator")]


def photographs(here: Path) -> tuple[Path, list[str]]:
    for part in ("images", "labels"):
        (here / "data" / part).mkdir(parents=True)
    for number in range(3):
        blobs = np.random.default_rng(number).integers(0, 256, (7, 9, 3)).astype(np.uint8)
        Image.fromarray(blobs).resize((72, 56)).save(here / "data/images" / f"{number}.png")
    changes = ["options.size=48", "data.val=train", "options.perceptual=0", "options.adversarial=0"]
    return here / "data", changes


def sectors(here: Path) -> tuple[Path, list[str]]:
    settings = {"latents": 4, "decoder": (4, 4, 6, 8), "encoder": (4, 6, 8)}
    torch.manual_seed(0)
    autoencoder = here / "autoencoder.safetensors"
    save(autoencoder, build("autoencoder", **settings), Card(network="autoencoder", settings=settings))
    own = [f"options.autoencoder={autoencoder}", "options.cache={out}-frames", *translated(here)]
    changes = ["scale=0.125", "options.columns=96", "data.train=all", "data.val=all", *own]
    return miniature_surround.write_pandaset(here / "data"), changes


def videos(here: Path) -> tuple[Path, list[str]]:
    clips = ["options.clip_length=5", "options.rows=32", "options.columns=48", "options.single_frame_splits="]
    changes = ["scale=1.0", "data.train=train", *clips]
    return miniature_video.write_video(here / "data", panorama=True), changes


FAMILIES: dict[str, Callable[[Path], tuple[Path, list[str]]]] = dict.fromkeys(SMALL, plain_data) | {
    "salsanext-mini": labelled_data,
    "sdnet-mini": camera_data,
    "titan-pano-mini": panorama_data,
    "autoencoder-mini": photographs,
    "latent-painter-mini": sectors,
    "vid2vid-mini": videos,
}


@pytest.mark.parametrize("recipe", FAMILIES)
def test_train_of_every_family(here, run, kills, recipe):
    if kills < 2:
        pytest.skip("one toy stands for all unless --kills asks for more")
    data, needed = FAMILIES[recipe](here)
    plain = ["training.steps=3", "training.workers=0", "training.precision=32-true", "training.checkpoint_minutes=1e-9"]
    changes = [word for change in (*plain, "training.batch=1", *needed) for word in ("--set", change)]

    def words(out: Path) -> list[str]:
        own = [change.replace("{out}", str(out)) for change in changes]
        return ["train", recipe, "--data", str(data), "--out", str(out), "--device", "cpu", *own]

    check_runs(here / "timed", after_kills(run, words, absolute, kills))
    for cache in here.glob("*-frames"):
        check_leavings(cache)


def test_export(here, run, kills):
    if kills < 2:
        pytest.skip("its test in a process is long; bulk and translate stand for it unless --kills asks for more")

    def words(out: Path) -> list[str]:
        return ["export", str(here / "small"), "--onnx", str(out)]

    check(here / "timed", after_kills(run, words, absolute, kills))


def test_bulk(here, run, kills):
    for number in range(4):
        write_scan(here / "drive" / f"{number:06d}.bin", street(seed=number))

    def words(out: Path) -> list[str]:
        options = ["--weights", str(here / "small"), "--device", "cpu", "--save", "all", "--out", str(out)]
        return ["bulk", str(here / "drive"), *options]

    folders = after_kills(run, words, absolute, kills)
    manifest = "manifest/0-of-1.jsonl"
    check(here / "timed", folders, without=("0-of-1.jsonl",))
    for folder in folders:
        lines = [json.loads(line) for line in (folder / manifest).read_text().splitlines()]
        assert sorted(line["input"] for line in lines) == [f"{number:06d}.bin" for number in range(4)]


def test_reproduce(here, run, kills):
    data = miniature.write_data_set(here / "data")

    def words(out: Path) -> list[str]:
        options = ["--rows", "scunet", "--budget", "4steps", "--segmenter", str(here / "small"), "--device", "cpu"]
        return ["reproduce", "--data", str(data), "--out", str(out), *options]

    folders = after_kills(run, words, absolute, kills)
    trained = Path("runs", "scunet")
    for folder in folders:
        assert gap(here / "timed" / trained, folder / trained) == 0
        assert plain(json.loads((folder / "results.json").read_text())) == plain(
            json.loads((here / "timed" / "results.json").read_text())
        )
        for part in ("images", "sheets", "data"):
            assert contents(folder / part) == contents(here / "timed" / part)
        check_leavings(folder)
