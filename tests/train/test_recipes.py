"""Recipes: values are changed by name and type or not at all, and what is written down is everything."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass, replace
from typing import Literal

import pytest

from lidar2pano.cli.train import brief
from lidar2pano.errors import InputError
from lidar2pano.models import MODELS, settings_of
from lidar2pano.train.environment import shared
from lidar2pano.train.recipe import Network, Optimizer, Recipe, TaskOptions, Training, override, resolved
from lidar2pano.train.recipes import MODULES, RECIPES, makers, recipe_named
from lidar2pano.train.sampling import steps_over
from lidar2pano.train.tasks import TASKS
from lidar2pano.views import VIEWS


@dataclass(frozen=True, kw_only=True)
class SampleOptions(TaskOptions):
    task = "sample"
    SIZES = ("columns",)
    lovasz: float = 1.0
    range: bool = True
    columns: int = 256
    mode: Literal["one", "two"] = "one"
    drop_probability: float = 0.5
    segmenter: str = ""


SAMPLE = Recipe(
    name="sample",
    view="panorama",
    networks={"painter": Network(model="latent-painter", settings={"blocks": 4, "widths": (32, 80, 144)})},
    options=SampleOptions(),
)


@pytest.mark.parametrize(
    ("assignment", "value"),
    [
        ("training.batch=16", 16),
        (" training.minutes = 2.5 ", 2.5),
        ("training.minutes=3", 3.0),
        ("training.channels_last=false", False),
        ("training.precision=32-true", "32-true"),
        ("data.train=train, labelled", ("train", "labelled")),
        ("networks.painter.optimizer.rate=1e-4", 1e-4),
        ("networks.painter.optimizer.betas=0.5,0.9", (0.5, 0.9)),
        ("networks.painter.optimizer.betas=(0, 0.5)", (0.0, 0.5)),
        ("networks.painter.settings.blocks=20", 20),
        ("networks.painter.settings.widths=[8,16]", (8, 16)),
        ("networks.painter.start=a=b.safetensors", "a=b.safetensors"),
        ("options.lovasz=0", 0.0),
        ("options.range=FALSE", False),
        ("options.segmenter=/some/file", "/some/file"),
        ("view=hdl64e", "hdl64e"),
    ],
)
def test_override_sets_one_value_of_the_right_type(assignment, value):
    changed = override(SAMPLE, assignment)
    path = assignment.partition("=")[0].strip().split(".")
    found, rest = changed, resolved(changed)
    for name in path:
        found = found[name] if isinstance(found, dict) else getattr(found, name)
    assert found == value and type(found) is type(value)
    expected = resolved(SAMPLE)
    inner = expected
    for name in path[:-1]:
        inner = inner[name]
    inner[path[-1]] = list(value) if isinstance(value, tuple) else value
    assert rest == expected  # and nothing else moved


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("training.batsh=8", "Training has no 'batsh'; did you mean 'batch'?"),
        ("trainin.batch=8", "Recipe has no 'trainin'; did you mean 'training'?"),
        ("networks.paint.start=x", "this recipe has no 'paint'; did you mean 'painter'?"),
        ("networks.painter.optimizer.rat=1", "Optimizer has no 'rat'; did you mean 'rate'?"),
        ("networks.painter.settings.blcks=1", "has no 'blcks'; did you mean 'blocks'?"),
        ("options.lovas=1", "has no 'lovas'; did you mean 'lovasz'?"),
        ("training.batch=8.5", "training.batch wants a whole number, not '8.5'"),
        ("training.batch=", "training.batch wants a whole number, not ''"),
        ("training.minutes=soon", "training.minutes wants a number, not 'soon'"),
        ("training.minutes=nan", "training.minutes wants a number, not 'nan'"),
        ("training.minutes=inf", "training.minutes wants a number, not 'inf'"),
        ("training.channels_last=1", "training.channels_last wants true or false, not '1'"),
        ("options.range=yes", "options.range wants true or false, not 'yes'"),
        ("training.precision=16-mixed", "training.precision cannot be '16-mixed'; did you mean 'bf16-mixed'?"),
        ("networks.painter.optimizer.betas=0.5", "wants 2 values with commas between"),
        ("networks.painter.settings.widths=8,x", "wants a whole number, not 'x'"),
        ("training=8", "training holds several values; set one of them: steps, epochs, minutes, batch"),
        ("networks.painter=8", "set one of them: model, settings"),
        ("options=8", "set one of them: lovasz"),
        ("training.batch.size=8", "int values have no parts; leave out 'size'"),
        ("training.batch", "is not of the form name=value"),
        ("=8", "is not of the form name=value"),
        ("training.batch=0", "must be at least 1"),
        ("training.ema=1", "training.ema=1 must be at least 0 and at most 1"),
        ("training.seed=-1", "training.seed=-1 must be at least 0"),
        ("training.checkpoint_minutes=-1", "training.checkpoint_minutes=-1 must be at least 0"),
        ("training.batch=1000000000", "training.batch=1e+09 must be at least 1 and at most 65536"),
        ("training.steps=" + 400 * "9", "training.steps wants a whole number, not '9999"),
        ("view=panorma", "no view 'panorma'; did you mean 'panorama'?"),
        ("scale=0", "recipe.scale=0 must be at least 0.001"),
        ("data.train=", "data.train and data.val must name at least one split each"),
        ("networks.painter.optimizer.rate=-1", "optimizer.rate=-1 must be at least 0"),
        ("networks.painter.optimizer.betas=0.5,1", "optimizer.betas=1 must be at least 0 and at most 1"),
        ("options.lovasz=-1", "options.lovasz=-1 must be at least 0"),
        ("options.columns=0", "options.columns=0 must be at least 1"),
        ("options.drop_probability=1.5", "options.drop_probability=1.5 must be at least 0 and at most 1"),
        ("options.mode=tow", "options.mode cannot be 'tow'; did you mean 'two'?"),
    ],
)
def test_override_refuses_with_one_line_that_helps(assignment, message):
    with pytest.raises(InputError) as refusal:
        override(SAMPLE, assignment)
    assert message in str(refusal.value) and "\n" not in str(refusal.value)


def test_override_leaves_the_recipe_as_it_was():
    before = resolved(SAMPLE)
    override(SAMPLE, "networks.painter.settings.blocks=3")
    override(SAMPLE, "options.lovasz=3")
    assert resolved(SAMPLE) == before


@pytest.mark.parametrize("first", ["batch", "accumulate"])
def test_batch_and_accumulate_are_compared_when_both_are_set(first):
    recipe = recipe_named("titan")  # 10 in 10 micro-batches
    for name in (first, {"batch": "accumulate", "accumulate": "batch"}[first]):
        recipe = override(recipe, f"training.{name}=2")
    assert shared(recipe.training, 1) == recipe.training


@pytest.mark.parametrize(
    ("batch", "accumulate", "processes", "hint"),
    [
        (10, 4, 2, "set training.accumulate=1, or make it a multiple of 8"),
        (8, 3, 1, "set training.accumulate=1, or make it a multiple of 3"),
        (9, 3, 2, "micro-batches; make it a multiple of 6"),
    ],
)
def test_a_batch_that_cannot_be_divided_is_refused_with_what_can(batch, accumulate, processes, hint):
    with pytest.raises(InputError) as refusal:
        shared(Training(batch=batch, accumulate=accumulate), processes)
    assert str(refusal.value).endswith(hint)


@pytest.mark.parametrize(("processes", "fewer"), [(1, 10), (2, 5), (5, 2), (10, 1)])
def test_more_devices_keep_the_batch_and_the_size_of_micro_batches(processes, fewer):
    training = recipe_named("titan").training
    found = shared(training, processes)
    assert found == replace(training, accumulate=fewer) and found.batch // (processes * fewer) == 1
    assert shared(Training(batch=12, accumulate=3), 2).accumulate == 3, "it divides: nothing changes"
    assert shared(Training(batch=12, accumulate=4), 2).accumulate == 2, "of 3 samples, as before"


def test_epochs_count_in_steps_of_the_data_at_hand():
    training = Training(steps=1000, epochs=1.5, batch=4)
    assert steps_over(10, training) == 4  # 15 samples
    assert steps_over(10_000, training) == 1000, "the steps come first"
    assert steps_over(10, Training(steps=7, batch=4)) == 7


def test_the_papers_protocol_is_in_the_recipes():
    for name in ("titan", "titan-no-lovasz", "titan-no-range", "titan-no-segments", "pix2pix-segments", "pix2pix-rgb",
                 "scunet", "titan-next"):  # fmt: skip
        recipe = recipe_named(name)
        assert (recipe.training.epochs, recipe.training.batch) == (118, 10)
        for network in recipe.networks.values():
            optimizer = network.optimizer
            assert (optimizer.algorithm, optimizer.rate, optimizer.betas) == ("adam", 1e-4, (0.5, 0.999))
            assert optimizer.schedule == "constant"
        assert getattr(recipe.options, "segments", "predicted") == "predicted"
        assert recipe_named(f"{name}-mini").training.epochs == 0
    salsanext = recipe_named("salsanext-published")
    assert (salsanext.training.epochs, salsanext.training.batch) == (150, 24)
    assert salsanext.networks["segmenter"].optimizer.algorithm == "sgd"


@pytest.mark.parametrize("name", RECIPES)
def test_every_recipe_names_what_exists_and_is_written_as_json(name):
    recipe = recipe_named(name)
    assert recipe.name == name and recipe.task in TASKS and recipe.view in VIEWS
    for spec in recipe.networks.values():
        assert spec.model in MODELS
        assert set(spec.settings) <= settings_of(MODELS[spec.model])
    written = resolved(recipe)
    assert json.loads(json.dumps(written, allow_nan=False)) == written
    assert written["training"]["batch"] == recipe.training.batch


def test_an_unknown_recipe_is_refused_with_the_nearest():
    with pytest.raises(InputError, match="no recipe 'titam'; did you mean 'titan'?"):
        recipe_named("titam")


def test_resolved_tells_recipes_apart():
    other = replace(SAMPLE, networks={"painter": Network(model="latent-painter", optimizer=Optimizer(warmup=1))})
    assert resolved(other) != resolved(SAMPLE) != resolved(replace(SAMPLE, training=Training(seed=1)))


def test_recipes_are_listed_without_torch():
    program = "import sys, lidar2pano.train.recipes as r; assert 'titan' in r.RECIPES and 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.parametrize("module", MODULES)
def test_recipes_are_named_where_they_are_made(module):
    assert tuple(makers(module)) == MODULES[module]


def test_the_first_lines_of_a_run_tell_its_limits():
    mini = recipe_named("titan-pano-mini")
    steps = mini.training.steps
    assert f"{steps} steps or 24 minutes, batches of 4, seed 0" in brief(mini)
    assert f"{steps} steps, no limit of time, batches of 4, seed 0" in brief(override(mini, "training.minutes=0"))
