"""evaluate --folds: a place counts once, whatever its number of frames; differences are paired by place."""

from __future__ import annotations

import csv
import gc
import json
import shutil
import statistics
import weakref

import pytest
import torch

from lidar2pano.cli import main
from lidar2pano.errors import InputError
from lidar2pano.evaluate import system
from lidar2pano.evaluate.folds import compared, parse_folds, scores_of, table
from lidar2pano.models.card import load, save
from random_weights import write_data_set


def test_folds_are_named_places(tmp_path):
    first, second = parse_folds([f"harbour={tmp_path}/a:b:val", "hills=data:all"])
    assert (first.name, str(first.root), first.split) == ("harbour", f"{tmp_path}/a:b", "val")
    assert (second.name, str(second.root), second.split) == ("hills", "data", "all")


@pytest.mark.parametrize(
    ("texts", "says"),
    [
        (["harbour"], "say NAME=ROOT:SPLIT"),
        (["harbour=data"], "say NAME=ROOT:SPLIT"),
        (["=data:val", "b=data:val"], "say NAME=ROOT:SPLIT"),
        (["a=data:val", "a=data:all"], "name a fold twice"),
        (["a=data:val"], "give two or more"),
    ],
)
def test_other_folds_are_refused(texts, says):
    with pytest.raises(InputError, match=says):
        parse_folds(texts)


FOLDED = {
    "old": {"a": {"camera miou": 0.3, "camera ssim": 0.1}, "b": {"camera miou": 0.4}, "c": {"camera miou": 0.5}},
    "new": {"a": {"camera miou": 0.4, "camera ssim": 0.1}, "b": {"camera miou": 0.4}, "c": {"camera miou": 0.6}},
}


def test_differences_are_paired_by_fold():
    comparison = compared(FOLDED)
    assert comparison["folds"] == ["a", "b", "c"]
    old, new = (system["scores"] for system in comparison["systems"])
    assert [row["name"] for row in new] == ["camera miou"]  # the other value is of one fold
    assert old[0]["difference"] == {"mean": 0, "reach": 0}
    gaps = [0.1, 0.0, 0.1]
    assert new[0]["mean"]["mean"] == pytest.approx(1.4 / 3)
    assert new[0]["difference"]["mean"] == pytest.approx(0.2 / 3)
    assert new[0]["difference"]["reach"] == pytest.approx(4.3027 * statistics.stdev(gaps) / 3**0.5, rel=1e-3)
    *_, line = table(comparison).splitlines()
    assert line == "| mIoU | new | 0.4000 | 0.4000 | 0.6000 | 0.4667 ± 0.2868 | 0.0667 ± 0.1434 |"


def test_two_folds_have_no_interval():
    two = {name: {fold: scores[fold] for fold in "ab"} for name, scores in FOLDED.items()}
    assert table(compared(two)).splitlines()[-1] == "| mIoU | new | 0.4000 | 0.4000 | 0.4000 | 0.0500 |"


def test_folds_without_a_common_value_are_refused():
    with pytest.raises(InputError, match="no value is defined on all of a, b"):
        compared({"one": {"a": {"camera ssim": 0.1}, "b": {"camera miou": 0.2}}})


def test_undefined_values_are_left_out():
    entries = [
        {"sector": "camera", "name": "miou", "value": 0.5},
        {"sector": "camera", "name": "ssim", "value": None},
        {"sector": "camera", "name": "swd_256", "value": 0.5},
    ]
    assert scores_of({"values": entries}) == {"camera miou": 0.5}


def test_each_fold_is_scored_by_weights_that_have_not_seen_it(tmp_path, random_weights, capsys):
    for seed, (name, frames) in enumerate({"hills": 2, "harbour": 1}.items()):
        write_data_set(tmp_path / name, frames=frames, size=(124, 38))
        shutil.copytree(random_weights, tmp_path / f"without-{name}")
        path = tmp_path / f"without-{name}" / "segmenter.safetensors"
        network, card = load(path)
        with torch.no_grad():
            for part in network.parameters():
                part.add_(torch.randn(part.shape) * (seed + 0.1) * 0.1)
        save(path, network, card)
    folds = [f"--folds={name}={tmp_path / name}:val" for name in ("hills", "harbour")]
    systems = [str(random_weights), f"{tmp_path}/without-{{fold}}", f"{tmp_path}/without-hills"]  # in one fold the same
    outputs = ["--json", str(tmp_path / "o.json"), "--csv", str(tmp_path / "o.csv")]
    command = ["evaluate", *systems, *folds, "--metrics", "points", "--device", "cpu", *outputs]
    assert main(command) == 0
    assert f"| points: mIoU | {systems[1]} | " in capsys.readouterr().out
    written = json.loads((tmp_path / "o.json").read_text())
    assert written["folds"] == ["hills", "harbour"]
    by_fold = {}
    for name in ("hills", "harbour"):
        alone = [
            "evaluate",
            f"{tmp_path}/without-{name}",
            "--data",
            str(tmp_path / name),
            "--metrics",
            "points",
        ]
        assert main([*alone, "--device", "cpu", "--json", str(tmp_path / "one.json")]) == 0
        entries = json.loads((tmp_path / "one.json").read_text())["results"][0]["values"]
        by_fold[name] = next(one["value"] for one in entries if (one["sector"], one["name"]) == ("points", "miou"))
    assert by_fold["hills"] != by_fold["harbour"]
    row = next(one for one in written["systems"][1]["scores"] if one["name"] == "points miou")
    assert row["values"] == [by_fold["hills"], by_fold["harbour"]]
    fixed = next(one for one in written["systems"][2]["scores"] if one["name"] == "points miou")
    assert fixed["values"][0] == by_fold["hills"] and fixed["values"][1] != by_fold["harbour"]
    assert row["mean"]["mean"] == pytest.approx(sum(by_fold.values()) / 2)  # not weighed by frames
    with (tmp_path / "o.csv").open(encoding="utf-8", newline="") as file:
        assert {line["fold"] for line in csv.DictReader(file)} == {"hills", "harbour"}


def test_no_more_folds_are_scored_once_they_have_nothing_in_common(tmp_path, random_weights, monkeypatch, capsys):
    scored = []

    def alone(_):
        scored.append(len(scored))
        return {f"camera {len(scored)}": 0.5}

    monkeypatch.setattr("lidar2pano.evaluate.folds.scores_of", alone)
    write_data_set(tmp_path, frames=1, size=(124, 38))
    folds = [f"--folds={name}={tmp_path}:val" for name in "abc"]
    command = ["evaluate", str(random_weights), *folds, "--metrics", "points", "--device", "cpu"]
    assert main(command) == 2
    assert "no value is defined on all of a, b;" in capsys.readouterr().err
    assert scored == [0, 1]


def test_networks_of_a_fold_are_gone_before_those_of_the_next_are_loaded(tmp_path, random_weights, monkeypatch):
    networks, alive = [], []

    def noted_system(*arguments, **options):
        gc.collect()
        alive.append(sum(network() is not None for network in networks))
        loaded = system(*arguments, **options)
        networks.append(weakref.ref(loaded.pipeline.segmenter.network))
        return loaded

    monkeypatch.setattr("lidar2pano.evaluate.system", noted_system)
    for name in ("hills", "harbour"):
        write_data_set(tmp_path / name, frames=1, size=(124, 38))
        shutil.copytree(random_weights, tmp_path / f"without-{name}")
    folds = [f"--folds={name}={tmp_path / name}:val" for name in ("hills", "harbour")]
    weights = [f"{tmp_path}/without-{{fold}}", str(random_weights)]
    assert main(["evaluate", *weights, *folds, "--metrics", "points", "--device", "cpu"]) == 0
    assert alive == [0, 1, 0, 1], "of the same fold only"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "say --data ROOT, or --folds"),
        (["--folds", "a=x:val", "--folds", "b=x:val", "--data", "x"], "--folds has no use for --data;"),
        (["--folds", "a=x:val", "--folds", "b=x:val", "--worst", "3"], "--folds has no use for --worst;"),
    ],
)
def test_options_that_contradict_folds_are_refused(words, says, random_weights, capsys):
    assert main(["evaluate", str(random_weights), *words]) == 2
    assert says in capsys.readouterr().err
