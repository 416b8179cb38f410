"""The tasks on a made-up data set: they learn, they score, and what they release fits the pipeline."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from torch import nn
from torch.utils.data import default_collate

from lidar2pano.data.frames import SampleIndex
from lidar2pano.errors import InputError
from lidar2pano.geometry.projection import Normalisation
from lidar2pano.labels import COMMON15
from lidar2pano.models import build
from lidar2pano.models.card import Card, load, save
from lidar2pano.models.families import weight_files
from lidar2pano.pipeline import Segmenter, load_translator
from lidar2pano.train.checkpoint import check_recipe, write_recipe
from lidar2pano.train.engine import train
from lidar2pano.train.recipe import Recipe, override, resolved
from lidar2pano.train.recipes import recipe_named
from lidar2pano.train.tasks import build_task
from lidar2pano.views import VIEWS
from miniature import write_data_set
from random_weights import PAINTER

ONE_STEP = ["training.steps=1", "training.batch=2", "training.workers=0", "training.precision=32-true"]
SMALL = {
    "salsanext-mini": ["options.columns=64", "data.train=train"],
    "titan-pano-mini": ["scale=0.125", "options.columns=160"],
    "titan-mini": ["view=titan-front-small"],
    "latent-painter-mini": ["scale=0.125", "options.columns=64"],
}
PUBLISHED = "networks.segmenter.settings.widths=32,64,128,256"
SETTINGS = {
    "segmenter": {"salsanext-mini": {"classes": 20, "channels": 5, "widths": (8, 8, 16, 16)}},
    "translator": {
        "titan-pano-mini": {"classes": 16, "conditions": 20, "widths": (8, 8, 8, 8, 8), "pyramid": 8},
        "titan-mini": {"classes": 15, "conditions": 20, "size": (92, 160)},
    },
    "painter": {"latent-painter-mini": PAINTER},
    "critic": {
        "titan-mini": {"image_channels": 15, "conditions": 20, "width": 4},
    },
}


pytestmark = pytest.mark.usefixtures("small_view")


def small(name: str, *further: str) -> Recipe:
    """A released recipe with networks and rasters small enough for a test; one step."""
    recipe = recipe_named(name)
    networks = {
        role: replace(network, settings=SETTINGS.get(role, {}).get(name, network.settings))
        for role, network in recipe.networks.items()
    }
    recipe = replace(recipe, networks=networks)
    for assignment in [*ONE_STEP, *SMALL[name], *further]:
        recipe = override(recipe, assignment)
    return recipe


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_data_set(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def runs(root, tmp_path_factory):
    """Runs of one step of segmenter, translator and painter, each with the weights of those before."""
    out = tmp_path_factory.mktemp("runs")
    train(small("salsanext-mini"), root, out / "segmenter", device="cpu")
    labels = f"options.segmenter={out / 'segmenter/weights/segmenter.safetensors'}"
    train(small("titan-pano-mini", labels), root, out / "translator", device="cpu")
    translator = f"options.translator={out / 'translator/weights/translator.safetensors'}"
    cache = f"options.cache={out / 'frames'}"
    settings = {"latents": 4, "encoder": (4, 6, 8), "decoder": (4, 4, 6, 8)}
    save(out / "a.safetensors", build("autoencoder", **settings), Card(network="autoencoder", settings=settings))
    latents = f"options.autoencoder={out / 'a.safetensors'}"
    train(small("latent-painter-mini", labels, translator, latents, cache), root, out / "painter", device="cpu")
    return out


def test_what_is_released_takes_its_part_in_the_pipeline(runs):
    for role in ("segmenter", "translator", "painter"):
        assert weight_files(runs / role)[role] == runs / role / "weights" / f"{role}.safetensors"
        _, card = load(weight_files(runs / role)[role])
        assert card.recipe.endswith("-mini")
        assert card.score["split"] == "val"
        assert card.steps == 1
        assert (runs / role / "preview").is_dir()


def test_a_segmenter_may_learn_from_scans_of_several_heights(root, tmp_path):
    tall = ("options.tallest=hdl64e-tall", "training.batch=2", "options.fixed_norms=true")
    with pytest.raises(InputError, match="training.accumulate=training.batch"):
        build_task(small("salsanext-mini", *tall), root)
    train(small("salsanext-mini", *tall, "training.accumulate=2"), root, tmp_path, device="cpu")
    network, card = load(tmp_path / "weights/segmenter.safetensors")
    assert Segmenter.from_card(network, card).tallest == VIEWS["hdl64e-tall"]
    norms = [part for part in network.modules() if isinstance(part, nn.BatchNorm2d)]
    assert all((norm.running_mean == 0).all() and (norm.running_var == 1).all() for norm in norms)


def test_a_translator_may_learn_a_taller_panorama(root, tmp_path):
    tall = ("view=panorama-tall", "scale=0.1", "options.columns=160")
    train(small("titan-pano-mini", *tall), root, tmp_path, device="cpu")
    file = tmp_path / "weights/translator.safetensors"
    _, card, view = load_translator(file, torch.device("cpu"))
    assert (card.views["panorama"]["rows"], card.views["panorama"]["up"]) == (80, VIEWS["panorama-tall"].up)
    assert view.rows == 48 and view.up == 0.24, "by default it is used on the panorama's rows"


def test_a_segmenter_may_read_roughness(root, tmp_path):
    six = ("networks.segmenter.settings.channels=6",)
    assert not build_task(small("salsanext-mini", *six), root).dataset.augmentation.moves
    train(small("salsanext-mini", *six), root, tmp_path, device="cpu")
    network, card = load(tmp_path / "weights/segmenter.safetensors")
    segmenter = Segmenter.from_card(network, card)
    assert segmenter.normalise == Normalisation.of(6)
    scan = build_task(small("salsanext-mini"), root).validation.scan(0)
    assert segmenter.points(scan).shape == (len(scan),)


def test_the_painter_says_which_weights_it_needs(root):
    with pytest.raises(InputError, match="options.segmenter"):
        build_task(small("latent-painter-mini", "options.autoencoder=a"), root)


@pytest.mark.parametrize(("name", "further"), [("salsanext-mini", [PUBLISHED]), ("titan-pano-mini", [])])
def test_the_loss_falls(root, name, further):
    task = build_task(small(name, *further), root)
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
    network = next(iter(task.networks.values()))
    optimizer = torch.optim.AdamW(network.parameters(), lr=3e-3)
    losses = []
    for _ in range(4):
        ((_, loss),) = task.updates(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert 0 < losses[-1] < 0.9 * losses[0]


def test_losses_with_a_margin_are_those_of_a_network_that_raises_buildings(root):
    plain, raised = (
        build_task(small("titan-pano-mini", *margin), root) for margin in ([], ["options.building_margin=1.5"])
    )
    batch = default_collate([plain.dataset[SampleIndex(index, index)] for index in range(2)])
    network, same = raised.networks["translator"].eval(), plain.networks["translator"].eval()
    network.load_state_dict(same.state_dict())
    with torch.no_grad():
        network.classes.bias[COMMON15.id_of("building")] += 1.5
    ((_, loss),), ((_, without),) = raised.updates(batch), plain.updates(batch)
    assert loss.item() == pytest.approx(without.item(), rel=1e-5)
    network.load_state_dict(same.state_dict())
    ((_, loss),) = raised.updates(batch)
    assert abs(loss.item() - without.item()) > 1e-2


def test_titan_net_moves_critic_and_translator_in_turn(root):
    task = build_task(small("titan-mini"), root)
    batch = default_collate([task.dataset[SampleIndex(index, index)] for index in range(2)])
    order = []
    for role, loss in task.updates(batch):
        order.append(role)
        task.networks[role].zero_grad()
        loss.backward()
        assert all(weight.grad is not None for weight in task.networks[role].parameters())
    assert order == ["critic", "translator"]
    assert task.logs["auxiliary"] > 0
    task.networks["translator"].eval()
    assert 0 <= task.validate()["score"] <= 1
    assert task.preview()["segments"].shape == (4 * 92, 160, 3)


def test_titan_net_learns_from_the_segmenters_labels_where_the_recipe_says_so(root, runs, tmp_path):
    wanted = "options.segments=predicted"
    with pytest.raises(InputError, match=r"predicted_labels/000000\.label: is missing; .*--labels-folder"):
        build_task(small("titan-mini", wanted), root).dataset[0]
    tree = write_data_set(tmp_path / "tree")
    for labels in sorted(tree.glob("sequences/*/labels")):  # what `prepare` writes; the data's own are not needed
        labels.rename(labels.parent / "predicted_labels")
    task = build_task(small("titan-mini", wanted), tree)
    plain = build_task(small("titan-mini"), root)
    assert torch.equal(task.dataset[0].segments, plain.dataset[0].segments)
    file = runs / "segmenter/weights/segmenter.safetensors"
    task = build_task(small("titan-mini", wanted, f"options.segmenter={file}"), root)
    only_validation = build_task(small("titan-mini", f"options.segmenter={file}"), root)
    assert not torch.equal(task.dataset[0].segments, plain.dataset[0].segments)
    assert torch.equal(task.validation[0].segments, only_validation.validation[0].segments)
    assert torch.equal(only_validation.dataset[0].segments, plain.dataset[0].segments)


def test_a_run_goes_on_that_began_when_recipes_had_fewer_values(tmp_path):
    recipe = small("salsanext-mini")
    (tmp_path / "checkpoints" / "000000001").mkdir(parents=True)
    before = resolved(recipe)
    del before["training"]["epochs"], before["options"]["class_weight_most"]
    del before["networks"]["segmenter"]["optimizer"]["final"]
    (tmp_path / "recipe.json").write_text(json.dumps(before))
    check_recipe(tmp_path, recipe)
    check_recipe(tmp_path, override(recipe, "training.steps=2"))
    with pytest.raises(InputError, match=r"options\.class_weight_most: 6\.0 -> 5\.0"):
        check_recipe(tmp_path, override(recipe, "options.class_weight_most=5"))


def test_a_run_goes_on_where_its_weight_files_lie_elsewhere(tmp_path):
    run, here, there = tmp_path / "run", tmp_path / "here.safetensors", tmp_path / "there.safetensors"
    here.write_bytes(b"weights")
    (run / "checkpoints" / "000000001").mkdir(parents=True)
    recipe = small("titan-mini")
    write_recipe(run, override(recipe, f"options.segmenter={here}"))
    here.rename(there)
    check_recipe(run, override(recipe, f"options.segmenter={there}"))
    there.write_bytes(b"other weights")
    with pytest.raises(InputError, match=r"options\.segmenter: .*here\.safetensors -> "):
        check_recipe(run, override(recipe, f"options.segmenter={there}"))
