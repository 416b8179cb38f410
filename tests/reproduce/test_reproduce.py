"""`lidar2pano reproduce`: plans, budgets, restarts, tables and the paper's orderings."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidar2pano import __version__
from lidar2pano.cli import main
from lidar2pano.cli.app import BROKEN, MISTAKE
from lidar2pano.data.frames import Frame, FrameList
from lidar2pano.data.layouts import frames
from lidar2pano.errors import InputError
from lidar2pano.reproduce import Outcome, Plan, run
from lidar2pano.reproduce.images import WIDTH, scalars, write_curves, write_sheets
from lidar2pano.reproduce.paper_tables import CLAIMS, ROWS, chosen
from lidar2pano.reproduce.results_page import results_page
from lidar2pano.reproduce.run import budget, sampled, splits, training_data
from lidar2pano.train.checkpoint import Progress, save_checkpoint
from lidar2pano.train.recipes import RECIPES
from semantic_kitti import write_semantic_kitti


def test_every_row_is_made_of_recipes_that_exist_in_both_forms():
    for row in ROWS.values():
        for part in row.parts:
            assert part == "oracle" or {part, f"{part}-mini"} <= RECIPES.keys()


def test_the_papers_values_are_those_of_its_tables():
    # table 2, the last column; table 1, the mean of its columns about as it prints it
    means = {name: row.paper["swd_pairs"] for name, row in ROWS.items() if row.paper}
    assert means["titan"] == 2.38 and means["scunet"] == 2.59 and means["ceiling"] == 1.76
    for row in ROWS.values():
        if row.classes:
            assert len(row.classes) == 14
            assert np.mean(row.classes) == pytest.approx(row.miou, abs=0.11)
        if row.paper and row.name not in ("Pix2Pix -> Vid2Vid",):  # whose printed mean (2.59) is not that of its levels
            levels = [value for key, value in row.paper.items() if key.startswith("swd_pairs_")]
            assert not levels or np.mean(levels) == pytest.approx(row.paper["swd_pairs"], abs=0.011)


def test_claims_name_rows():
    assert all({claim.first, claim.second} <= ROWS.keys() for claim in CLAIMS)


def test_rows_are_chosen_by_name():
    assert list(chosen("scunet, titan")) == ["titan", "scunet"]
    assert chosen("") == ROWS
    with pytest.raises(InputError, match="titan"):
        chosen("titann")


@pytest.mark.parametrize(
    ("text", "steps", "minutes"),
    [("90s", "10000000", 1.5), ("20m", "10000000", 20), ("2h", "10000000", 120), ("500steps", "500", 0)],
)
def test_budgets(text, steps, minutes):
    changes = dict(change.split("=") for change in budget(text))
    assert changes["training.steps"] == steps and float(changes["training.minutes"]) == minutes


@pytest.mark.parametrize("text", ["", "5 minutes", "m", "0m", "1.2.3m", "-3m"])
def test_other_budgets_are_refused(text):
    if text:
        with pytest.raises(InputError, match="90s, 20m"):
            budget(text)
    else:
        assert budget(text) == []


@pytest.fixture
def plan(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "splits.json").write_text(json.dumps({"train": ["00/000000"], "val": ["00/000001"]}))
    return Plan(data=tmp_path / "data", out=tmp_path / "out", budget="10s")


def test_parts_come_once_and_a_painter_after_its_translator(plan):
    parts = plan.parts
    assert len(set(parts)) == len(parts) and "oracle" not in parts
    assert parts[0] == "salsanext" and parts[-2:] == ["autoencoder", "latent-painter"] and "titan-pano" in parts
    assert "autoencoder" not in replace(plan, rows={"titan": ROWS["titan"]}).parts
    assert "salsanext" not in replace(plan, segmenter="streets").parts


def test_recipes_fit_the_data_at_hand(plan, tmp_path):
    recipe = plan.recipe("salsanext", {})
    assert recipe.data.train == ("train",), "there is no split `labelled` here"
    video = plan.recipe("vid2vid", {})
    assert video.data.train == ("train",) and video.options.single_frame_splits == ("train", "selection")
    files = {"salsanext": tmp_path / "s", "titan-pano": tmp_path / "t"}
    painter = plan.recipe("latent-painter", files | {"autoencoder": tmp_path / "a"}).options
    assert [Path(file).name for file in (painter.segmenter, painter.translator, painter.autoencoder)] == list("sta")
    assert painter.cache == str(plan.out / "sectors")
    changed = replace(plan, changes=("titan.training.batch=3", "scunet.training.seed=5"))
    assert changed.recipe("titan", {}).training.batch == 3 and changed.recipe("scunet", {}).training.seed == 5
    assert plan.recipe("titan", {}).training.batch != 3
    assert plan.recipe("titan", {}).name == "titan-mini"
    assert replace(plan, mini=False).recipe("titan", {}).name == "titan"


def test_chains_name_runs_in_the_order_of_the_row(plan):
    runs = plan.out / "runs"
    assert plan.chain(ROWS["titan"]) == f"{runs / 'salsanext'}+{runs / 'titan'}+{runs / 'vid2vid'}"
    assert plan.chain(ROWS["ceiling"]) == f"oracle+{runs / 'vid2vid'}"
    assert plan.chain(ROWS["scunet"]) == str(runs / "scunet")


def test_a_damaged_listing_of_splits_is_an_input_error(plan):
    (plan.data / "splits.json").write_text("{")
    with pytest.raises(InputError, match=r"splits\.json"):
        splits(plan.data)


def frame_names(**ranges):
    return [f"{sequence[1:]}/{number:06d}" for sequence, numbers in ranges.items() for number in numbers]


@pytest.mark.parametrize(
    ("names", "selected"),
    [(frame_names(_00=range(3), _01=range(2)), frame_names(_01=range(2))),
     (frame_names(_00=range(4), _01=range(6)) + frame_names(_00=[4]), frame_names(_00=range(5))),  # they interleave
     (frame_names(_00=range(20)), frame_names(_00=[18, 19])),
     (frame_names(_00=[0], _01=range(19)), frame_names(_01=[17, 18])),  # without 01 a frame would be left
     (frame_names(_00=[0]), frame_names(_00=[0]))],
)  # fmt: skip
def test_checkpoints_are_selected_on_training_frames_that_are_not_trained_on(tmp_path, names, selected):
    kept = [name for name in names if name not in selected] or names
    for name in [*names, "08/000000"]:
        path = tmp_path / "data" / "sequences" / name.replace("/", "/velodyne/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_suffix(".bin").touch()
    listing = {"train": names, "val": ["08/000000"], "all": [*names, "08/000000"]}
    (tmp_path / "data" / "splits.json").write_text(json.dumps(listing))
    plan = Plan(data=tmp_path / "data", out=tmp_path / "out")
    folder = training_data(plan)
    found = {split: list(frames(folder, split).names) for split in ("train", "selection", "val")}
    assert found == {"train": kept, "selection": selected, "val": ["08/000000"]}
    assert plan.recipe("titan", {}).data.val == ("selection",) and training_data(plan) == folder
    assert json.loads((plan.data / "splits.json").read_text()) == listing
    with pytest.raises(InputError, match="all frames of `train` are in `all`, which is scored"):
        training_data(replace(plan, split="all"))
    (folder / "sequences").unlink()
    (folder / "sequences").symlink_to(tmp_path)
    with pytest.raises(InputError, match="sequences: is no link to .*data/sequences; remove it"):
        training_data(plan)


@pytest.mark.parametrize(
    ("count", "numbers"),
    [(0, list(range(10))), (10, list(range(10))), (99, list(range(10))), (1, [0]), (4, [0, 3, 6, 9])],
)
def test_scored_frames_reach_from_the_first_to_the_last(count, numbers):
    split = FrameList((f"00/{number:06d}", Frame) for number in range(10))
    scored = sampled(split, count)
    assert [int(name.partition("/")[2]) for name in scored.names] == numbers
    assert [frame.name for frame in scored] == list(scored.names)


def result(steps=1000, low=None, high=None, frames=50, painter=2000, **values):
    more = {"low": low, "high": high, "frames": frames}
    rows = [{"sector": "camera", "name": name, "value": value, **more} for name, value in values.items()]
    rows.append({"sector": "panorama", "name": "miou", "value": 0.25})
    networks = {"segmenter": {"steps": 1}, "translator": {"steps": steps}, "painter": {"steps": painter}}
    one = {
        "networks": networks,
        "values": rows,
        "milliseconds": {"translate": 12.4},
        "classes": [{"class": "car", "iou": 0.5}],
    }
    return {"heading": "`val` of data: 1 image.", "classes": ["car"], "results": [one]}


@pytest.mark.parametrize(("known", "said"), [("0a1b2c", "Commit 0a1b2c,"), (__version__, f"Version {__version__},")])
def test_the_results_page_says_of_which_program_it_is(plan, monkeypatch, known, said):
    monkeypatch.setattr("lidar2pano.reproduce.results_page.commit", lambda: known)
    assert f"not edited by hand. {said}" in results_page(plan, Outcome(), [], None)


def test_the_results_page_has_every_row_and_a_verdict_where_it_can(plan):
    outcome = Outcome(
        results={
            "titan": result(miou=0.3, swd_pairs=20.0, low=0.25, high=0.35),
            "pix2pix": result(miou=0.1, swd_pairs=10.0, low=0.05, high=0.15),
        },
        camera_segmenter_ms=198.2,
        failures={"scunet": "no image goes with this scan"},
    )
    text = results_page(plan, outcome, [], None)
    for row in ROWS.values():
        assert row.name in text
    assert "TITAN-Net beats Pix2Pix in mIoU: **confirmed** here (0.3 against 0.1)" in text
    assert "TITAN-Net beats Pix2Pix in SWD: **contradicted** here (20 against 10)" in text
    assert "| TITAN-Net -> Vid2Vid | translate 12 | 12 |" in text
    assert "| SD-Net (in training only) | segment an image 198 | 198 |" in text
    assert "Lovasz-Softmax raises mIoU: not measured here" in text
    assert "scunet: no image goes with this scan" in text and "no Inception weights" in text
    titan = next(line for line in text.splitlines() if line.startswith("| TITAN-Net -> Vid2Vid |"))
    assert "| 50.0 |" in titan and "**30.0**" in titan


@pytest.mark.parametrize(
    ("first", "second", "verdict"),
    [
        (result(miou=0.3, low=0.25, high=0.35), result(miou=0.1, low=0.05, high=0.2), "**confirmed** here (0.3"),
        (result(miou=0.3, low=0.15, high=0.35), result(miou=0.1, low=0.05, high=0.2), "**not decided** here: the 95 %"),
        (result(miou=0.1, low=0.05, high=0.2), result(miou=0.3, low=0.25, high=0.35), "**contradicted** here (0.1"),
        (result(miou=0.3, steps=20), result(miou=0.1), "**not decided** here: 20 steps of training"),
        (result(miou=0.3), result(miou=0.1, frames=6), "**not decided** here: 6 frames are fewer than 50"),
        (result(miou=0.3), result(miou=0.1), "**not decided** here: there are no intervals"),
    ],
)
def test_orderings_are_decided_by_disjoint_intervals_after_enough_training(plan, first, second, verdict):
    text = results_page(plan, Outcome(results={"titan": first, "pix2pix": second}), [], None)
    assert f"TITAN-Net beats Pix2Pix in mIoU: {verdict}" in text


def test_a_painter_of_few_steps_decides_nothing_about_images_and_leaves_segments_alone(plan):
    better = result(miou=0.3, swd_pairs=0.3, low=0.25, high=0.35, painter=20)
    worse = result(miou=0.1, swd_pairs=0.1, low=0.05, high=0.15)
    text = results_page(plan, Outcome(results={"titan": better, "pix2pix": worse}), [], None)
    assert "in mIoU: **confirmed** here" in text
    assert "TITAN-Net beats Pix2Pix in SWD: **not decided** here: 20 steps of training" in text


def test_sheets_are_side_by_side_and_leave_out_missing_images(tmp_path):
    from PIL import Image

    for row, grey in (("ground-truth", 10), ("titan", 200)):
        (tmp_path / "images" / row).mkdir(parents=True)
        image = np.full((30, 60, 3), grey, dtype=np.uint8)
        Image.fromarray(image).save(tmp_path / "images" / row / "00.colour.png")
    paths = write_sheets(tmp_path / "images", tmp_path / "sheets", {"titan": "TITAN-Net"})
    assert [path.stem for path in paths] == ["segments", "ablations"]
    sheet = np.array(Image.open(paths[0]))
    assert sheet.shape[1] == 2 * WIDTH
    assert abs(int(sheet[-20, 40, 0]) - 10) < 4 and abs(int(sheet[-20, WIDTH + 40, 0]) - 200) < 4


def test_curves_are_drawn_of_losses_alone(tmp_path):
    from torch.utils.tensorboard import SummaryWriter

    for row, values in (("titan", (3.0, 2.0, 1.0)), ("scunet", (1.0,))):
        with SummaryWriter(str(tmp_path / row / "tensorboard")) as writer:
            for step, value in enumerate(values):
                writer.add_scalar("loss", value, step)
                writer.add_scalar("rate/translator", 0.1, step)
    assert scalars(tmp_path / "titan")["loss"] == [(0, 3.0), (1, 2.0), (2, 1.0)]
    assert scalars(tmp_path / "nothing") == {}
    path = write_curves({name: tmp_path / name for name in ("titan", "scunet", "nothing")}, tmp_path / "curves.png")
    assert path is not None and path.stat().st_size > 1000
    assert write_curves({"scunet": tmp_path / "scunet"}, tmp_path / "none.png") is None, "one point is no curve"


@pytest.fixture(scope="module")
def semantic_kitti(tmp_path_factory):
    return write_semantic_kitti(tmp_path_factory.mktemp("sk"), scale=0.25)


def test_semantic_kitti_as_users_have_it_and_a_second_run_that_only_reads(
    semantic_kitti, random_weights, tmp_path, capsys
):
    words = ["reproduce", "--data", str(semantic_kitti), "--out", str(tmp_path), "--rows", "scunet", "--device", "cpu"]
    words += ["--budget", "1steps", "--segmenter", str(random_weights / "segmenter.safetensors")]
    words += ["--set", "scunet.options.size=47,155"]
    assert main(words) == 0
    assert "training scunet-mini on 9 frames, its checkpoints selected on 1" in capsys.readouterr().err
    text = (tmp_path / "RESULTS.md").read_text()
    row = next(line for line in text.splitlines() if line.startswith("| SC-UNET |"))
    assert 0 < float(row.split("|")[2]) < 1, "SSIM"
    assert "`val`" in text and ": 1 camera images" in text and "the camera's images (1)" in text
    assert (tmp_path / "images" / "ground-truth" / "00.colour.png").is_file()
    rows = tmp_path / "rows" / "scunet.json"
    weights = tmp_path / "runs" / "scunet" / "weights" / "renderer.safetensors"
    held = {path: path.stat().st_mtime_ns for path in (rows, weights)}
    assert main(words) == 0
    assert {path: path.stat().st_mtime_ns for path in held} == held
    labels = semantic_kitti / "sequences" / "08" / "camera_labels" / "000000.png"
    labels.write_bytes(labels.read_bytes())  # as by another `prepare`
    assert main(words) == 0
    assert {path: path.stat().st_mtime_ns == changed_ns for path, changed_ns in held.items()} == {
        rows: False, weights: True,
    }  # fmt: skip
    rows.write_text("{")  # a damaged row is scored again
    assert main(words) == 0
    assert json.loads(rows.read_text())["result"]["camera_images"] == 1
    capsys.readouterr()


def test_without_camera_labels_the_page_names_the_command_that_makes_them(random_weights, tmp_path, capsys):
    data = write_semantic_kitti(tmp_path / "data", camera_labels=False, scale=0.25)
    words = ["reproduce", "--data", str(data), "--out", str(tmp_path / "out"), "--rows", "titan", "--device", "cpu"]
    segmenter = str(random_weights / "segmenter.safetensors")
    assert main([*words, "--budget", "1steps", "--segmenter", segmenter]) == BROKEN
    assert "lidar2pano prepare" in (tmp_path / "out" / "RESULTS.md").read_text()
    assert "titan" in capsys.readouterr().err


def test_a_dry_run_names_trainings_disk_and_gaps_and_writes_nothing(tmp_path, capsys):
    data = write_semantic_kitti(tmp_path / "data", camera_labels=False)
    words = ["reproduce", "--data", str(data), "--out", str(tmp_path / "out"), "--rows", "titan", "--form", "mini"]
    words += ["--budget", "20m", "--dry-run", "--device", "cpu"]
    assert main(words) == MISTAKE
    out, err = capsys.readouterr()
    lines = [line.split() for line in out.splitlines()]
    assert [line[:3] for line in lines[:3]] == [
        ["salsanext", "salsanext-mini", "20"],
        ["titan", "titan-mini", "20"],
        ["vid2vid", "vid2vid-mini", "20"],
    ]
    assert out.splitlines()[3].startswith("3 trainings: 60 min, and up to ") and "GiB" in out
    assert "1 rows scored on 1 frames of val" in out
    assert "missing: split val: " in err and "has no camera labels: lidar2pano prepare" in err
    assert not (tmp_path / "out").exists()
    assert main([*words, "--set", "titan.training.stepps=1"]) == MISTAKE
    assert "stepps" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("progress", "budget", "finished"),
    [
        (Progress(step=5, validated=5, finished=5), "5steps", True),
        (Progress(step=3, validated=3), "5steps", False),  # paused: it has weights, too
        (Progress(step=5, validated=5, finished=5), "9steps", False),  # it goes on
        (Progress(step=5, seconds=90.0, finished=5), "90s", True),
        (Progress(step=5, seconds=90.0, finished=5), "2m", False),
        (None, "5steps", False),
    ],
)
def test_only_finished_trainings_cost_nothing_more(semantic_kitti, tmp_path, capsys, progress, budget, finished):
    run_folder = tmp_path / "runs" / "scunet"
    (run_folder / "weights").mkdir(parents=True)
    if progress:
        save_checkpoint(run_folder, progress, {}, {})
    words = ["reproduce", "--data", str(semantic_kitti), "--out", str(tmp_path), "--rows", "scunet", "--device", "cpu"]
    assert main([*words, "--segmenter", "world", "--budget", budget, "--dry-run"]) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[0].endswith("  finished") == finished
    assert f"{0 if finished else 1} trainings" in out and "1 rows scored" in out


def test_a_dry_run_names_a_damaged_checkpoint(semantic_kitti, tmp_path, capsys):
    folder = save_checkpoint(tmp_path / "runs" / "scunet", Progress(step=5, finished=5), {}, {})
    (folder / "state.json").write_text("{")
    words = ["reproduce", "--data", str(semantic_kitti), "--out", str(tmp_path), "--rows", "scunet", "--device", "cpu"]
    assert main([*words, "--segmenter", "world", "--budget", "5steps", "--dry-run"]) == MISTAKE
    assert "000000005 is damaged" in capsys.readouterr().err


def test_a_missing_package_is_named_before_the_first_training(semantic_kitti, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(run, "find_spec", lambda name: None if name == "cv2" else object())
    words = ["reproduce", "--data", str(semantic_kitti), "--out", str(tmp_path / "out"), "--device", "cpu"]
    assert main([*words, "--rows", "titan"]) == MISTAKE
    assert "reproduce needs cv2: pip install 'lidar2pano[train]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main([*words, "--rows", "scunet", "--segmenter", "world", "--dry-run"]) == 0, "it needs no flow"
