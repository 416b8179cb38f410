"""runs/cross_validation.py: no run sees the place that it is scored on; differences are paired by place."""

from __future__ import annotations

import runpy
from types import SimpleNamespace

import house_rules

SCRIPT = house_rules.ROOT / "runs" / "cross_validation.py"
SCORES = {
    ("old", "a"): 0.3,
    ("old", "b"): 0.4,
    ("old", "c"): 0.5,
    ("new", "a"): 0.4,
    ("new", "b"): 0.4,
    ("new", "c"): 0.6,
}


def test_each_place_is_scored_by_runs_that_never_saw_it(tmp_path, monkeypatch, capsys):
    seen = {}

    def train(recipe, root, out, device):
        seen[out.name] = recipe.data.train, recipe.data.val, recipe.training.steps, recipe.options.remission_octaves
        (out / "weights").mkdir(parents=True)
        (out / "weights" / "translator.safetensors").touch()
        return out / "weights"

    def load(path):
        arm, place = path.parts[-3].split("-without-")
        return None, SimpleNamespace(score={"miou": SCORES[arm, place], "split": "x"})

    main = runpy.run_path(str(SCRIPT))["main"]
    monkeypatch.setitem(main.__globals__, "train", train)
    monkeypatch.setitem(main.__globals__, "load", load)
    places = [f"--place={name}=/{name}:all" for name in "abc"]
    arms = ["--arm", "old", "--arm", "new", "options.remission_octaves=3"]
    words = [
        "x",
        "fast-translator-mini",
        str(tmp_path),
        *places,
        *arms,
        "--always=/towns:all",
        "--set",
        "training.steps=7",
    ]
    monkeypatch.setattr("sys.argv", words)
    main()
    assert len(seen) == 6
    for name, (trained, scored, steps, octaves) in seen.items():
        arm, place = name.split("-without-")
        assert set(trained) == {f"/{one}:all" for one in "abc" if one != place} | {"/towns:all"}
        assert (scored, steps, octaves) == ((f"/{place}:all",), 7, 3.0 if arm == "new" else 0.0)
    *_, old, new = capsys.readouterr().out.splitlines()
    assert old == "| validation: mIoU | old | 0.3000 | 0.4000 | 0.5000 | 0.4000 ± 0.2484 | 0.0000 ± 0.0000 |"
    # gaps .1, 0, .1: mean .0667, deviation .0577; t(2) at 97.5 % is 4.303, / sqrt(3): 0.1434
    assert new == "| validation: mIoU | new | 0.4000 | 0.4000 | 0.6000 | 0.4667 ± 0.2868 | 0.0667 ± 0.1434 |"
    assert (tmp_path / "folds.md").read_text().splitlines()[-1] == new
