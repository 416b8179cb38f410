"""Camera teachers of `transformers`: tiny untrained models, saved to a folder and read again without a network."""

from __future__ import annotations

import json
import pickle
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lidar2pano.errors import InputError
from lidar2pano.labels import CITYSCAPES
from lidar2pano.models import camera_teachers
from lidar2pano.models.camera_teachers import (
    MODEL_TYPES,
    MaskSegmenter,
    cityscapes_classes,
    load_teacher,
    local_folder,
    parts_of,
)

transformers = pytest.importorskip("transformers")

from teacher_models import DEVIATION, MEAN, NAMES, TEXT, write_model  # noqa: E402

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A folder per kind."""
    transformers.utils.logging.disable_progress_bar()
    return {family: write_model(tmp_path_factory.mktemp(family), family) for family in MODEL_TYPES}


@pytest.fixture
def own_copy(models: dict[str, Path], tmp_path: Path) -> Path:
    """A copy of the Mask2Former that may be damaged."""
    return Path(shutil.copytree(models["mask2former"], tmp_path / "mine"))


def coarse_image(rows: int, columns: int) -> np.ndarray:
    coarse = np.random.default_rng(1).integers(0, 256, (rows // 8 + 1, columns // 8 + 1, 3), dtype=np.uint8)
    return coarse.repeat(8, 0).repeat(8, 1)[:rows, :columns]


every_family = pytest.mark.parametrize("family", MODEL_TYPES)


@every_family
@pytest.mark.parametrize("size", [(50, 70), (32, 64), (33, 97)])
def test_probabilities_of_any_size(models: dict[str, Path], family: str, size: tuple[int, int]) -> None:
    answer = load_teacher(family, models[family], CPU).probabilities(coarse_image(*size))
    assert answer.shape == (19, *size) and answer.dtype == torch.float32
    assert (answer >= 0).all()
    torch.testing.assert_close(answer.sum(0), torch.ones(size))
    assert answer.std(0).mean() > 1e-3


@every_family
def test_answers_are_those_of_transformers_own_way(models: dict[str, Path], family: str) -> None:
    """Its image processor and semantic inference, on a picture of the one size that its Mask2Former can answer in."""
    from transformers.models.mask2former.image_processing_pil_mask2former import Mask2FormerImageProcessorPil

    image = coarse_image(384, 384)
    processor = Mask2FormerImageProcessorPil(do_resize=False, image_mean=MEAN, image_std=DEVIATION)
    network = getattr(transformers, MODEL_TYPES[family]).from_pretrained(models[family]).eval()
    given = {"pixel_values": processor(image, return_tensors="pt")["pixel_values"]}
    if family == "oneformer":
        reader = transformers.AutoTokenizer.from_pretrained(models[family])
        (ids,) = reader([TEXT], padding="max_length", max_length=24, truncation=True)["input_ids"]
        end = ids.index(reader.eos_token_id)
        assert 10 < end < 23
        given["task_inputs"] = torch.tensor([[*ids[: end + 1], *[0] * (23 - end)]])
    with torch.inference_mode():
        outputs = network(**given)
    (found,) = processor.post_process_semantic_segmentation(outputs, [(384, 384)], return_segmentation_scores=True)
    scores = found.segmentation_scores
    total = scores.sum(0, keepdim=True)
    expected = torch.stack([scores[NAMES.index(name)] for name in CITYSCAPES.classes]) / total.clamp(min=1)
    expected = expected + (1 - expected.sum(0)) / 19
    ours = load_teacher(family, models[family], CPU).probabilities(image)
    torch.testing.assert_close(ours, expected, atol=2e-5, rtol=0)
    assert (ours.argmax(0) == expected.argmax(0)).float().mean() > 0.999
    assert expected.argmax(0).unique().numel() > 1


class Answering(torch.nn.Module):
    """A network that gives back fixed queries, its masks as large as a quarter of the picture."""

    def __init__(self, classes: torch.Tensor, masks: torch.Tensor) -> None:
        super().__init__()
        self.classes, self.masks, self.inputs = classes, masks, []

    def forward(self, pixel_values: torch.Tensor) -> Any:
        self.inputs.append(pixel_values)
        rows, columns = pixel_values.shape[-2] // 4, pixel_values.shape[-1] // 4
        masks = self.masks[None, :, None, None].expand(1, -1, rows, columns)
        return type("Answer", (), {"class_queries_logits": self.classes[None], "masks_queries_logits": masks})()


def test_unclaimed_probability_is_spread_over_all_classes() -> None:
    sure = torch.full((2, 21), -30.0)
    sure[0, 3], sure[1, 0] = 30.0, 30.0  # one query says class 3, one says class 0, which Cityscapes has not
    network = Answering(sure, torch.log(torch.tensor([0.5 / 0.5, 0.3 / 0.7])))  # masks of 0.5 and 0.3
    normalise = camera_teachers.ImageNormalisation()
    teacher = MaskSegmenter(network=network, classes=torch.arange(1, 20), normalise=normalise)
    answer = teacher.probabilities(coarse_image(20, 40))
    rest = (1 - 0.5) / 19
    torch.testing.assert_close(answer[2], torch.full((20, 40), 0.5 + rest))
    torch.testing.assert_close(answer[0], torch.full((20, 40), rest))


def test_images_are_padded_with_their_border_and_used_in_every_scale() -> None:
    network = Answering(torch.randn(3, 20), torch.randn(3))
    plain = camera_teachers.ImageNormalisation(mean=(0, 0, 0), deviation=(1, 1, 1))
    teacher = MaskSegmenter(network=network, classes=torch.arange(19), normalise=plain, scales=(0.5, 1.0, 2.0))
    image = coarse_image(20, 40)
    teacher.probabilities(image)
    assert [tuple(one.shape) for one in network.inputs] == [(1, 3, 32, 32), (1, 3, 32, 64), (1, 3, 64, 96)]
    whole = network.inputs[1]
    torch.testing.assert_close(whole[0, :, :20, :40], torch.from_numpy(image).movedim(2, 0) / 255)
    assert torch.equal(whole[0, :, 20:, 40:], whole[0, :, 19:20, 39:40].expand(3, 12, 24))


def test_scales_are_averaged(models: dict[str, Path]) -> None:
    image = coarse_image(64, 96)
    one, two = (load_teacher("mask2former", models["mask2former"], CPU, (s,)).probabilities(image) for s in (1.0, 2.0))
    both = load_teacher("mask2former", models["mask2former"], CPU, (1.0, 2.0)).probabilities(image)
    torch.testing.assert_close(both, (one + two) / 2)
    assert (one - two).abs().max() > 1e-3


def test_classes_go_by_name() -> None:
    shuffled = {number: name.upper().replace(" ", "_") for number, name in enumerate(NAMES)}
    ids = cityscapes_classes(shuffled)
    assert [NAMES[i] for i in ids] == list(CITYSCAPES.classes)
    with pytest.raises(InputError, match="model: has no class 'rider', 'train'; name a model that was trained on Cit"):
        cityscapes_classes({n: c for n, c in enumerate(CITYSCAPES.classes) if c not in {"rider", "train"}})


def test_a_oneformer_saved_while_training_is_a_teacher_too(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "one", "oneformer", is_training=True)
    answer = load_teacher("oneformer", folder, CPU).probabilities(coarse_image(40, 40))
    assert answer.isfinite().all()


def test_a_processor_saved_in_the_newer_way(own_copy: Path) -> None:
    old = load_teacher("mask2former", own_copy, CPU)
    values = json.loads((own_copy / "preprocessor_config.json").read_text())
    (own_copy / "preprocessor_config.json").unlink()
    (own_copy / "processor_config.json").write_text(json.dumps({"image_processor": values}))
    assert load_teacher("mask2former", own_copy, CPU).normalise == old.normalise
    assert old.normalise.mean == tuple(MEAN) and old.normalise.deviation == tuple(DEVIATION)


def test_loading_says_nothing_and_leaves_the_library_as_it_was(
    models: dict[str, Path], capfd: pytest.CaptureFixture[str]
) -> None:
    said = transformers.utils.logging
    said.enable_progress_bar()
    said.set_verbosity(said.WARNING)
    try:
        load_teacher("oneformer", models["oneformer"], CPU)
        assert capfd.readouterr() == ("", "")
        assert said.is_progress_bar_enabled() and said.get_verbosity() == said.WARNING
    finally:
        said.disable_progress_bar()


# --- what can be wrong ----------------------------------------------------------------------------------------------


def without_a_weight(folder: Path) -> None:
    from safetensors.torch import load_file, save_file

    state = load_file(folder / "model.safetensors")
    save_file({k: v for k, v in state.items() if k != "class_predictor.weight"}, folder / "model.safetensors")


def cut_off(folder: Path) -> None:
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-1000])


def other_names(folder: Path) -> None:
    config = json.loads((folder / "config.json").read_text())
    config["id2label"]["1"] = "sofa"  # NAMES[1] is the bicycle
    (folder / "config.json").write_text(json.dumps(config))


BAD = {
    "a weight is missing": (without_a_weight, "1 weights are missing, the first is 'class_predictor.weight'"),
    "cut off": (cut_off, "cannot be loaded as a mask2former"),
    "no weights": (lambda folder: (folder / "model.safetensors").unlink(), "cannot be loaded as a mask2former"),
    "no settings": (lambda folder: (folder / "config.json").unlink(), "config.json: cannot be read (No such file"),
    "broken settings": (lambda folder: (folder / "config.json").write_text("{"), "config.json: is no JSON ("),
    "strange settings": (lambda folder: (folder / "config.json").write_text("[]"), "config.json: are no settings"),
    "no mean": (lambda folder: (folder / "preprocessor_config.json").write_text("{}"), "has no image_mean and image_s"),
    "no processor": (lambda folder: (folder / "preprocessor_config.json").unlink(), "processor_config.json: cannot be"),
    "another class": (other_names, "has no class 'bicycle'"),
}


@pytest.mark.parametrize("how", BAD)
def test_a_bad_folder_is_refused_in_one_line(own_copy: Path, how: str) -> None:
    damage, said = BAD[how]
    damage(own_copy)
    with pytest.raises(InputError) as caught:
        load_teacher("mask2former", own_copy, CPU)
    assert str(caught.value).startswith(str(own_copy)) and said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_another_family_is_refused(models: dict[str, Path]) -> None:
    with pytest.raises(InputError, match="holds a 'mask2former', not a 'oneformer'; name another folder"):
        load_teacher("oneformer", models["mask2former"], CPU)


def test_hostile_weights_run_nothing(own_copy: Path) -> None:
    class Hostile:
        def __reduce__(self) -> Any:
            return Path.touch, (own_copy / "marker",)

    (own_copy / "model.safetensors").unlink()
    torch.save({"class_predictor.weight": Hostile()}, own_copy / "pytorch_model.bin")
    with pytest.raises(InputError, match="cannot be loaded as a mask2former"):
        load_teacher("mask2former", own_copy, CPU)
    assert not (own_copy / "marker").exists()
    torch.load(own_copy / "pytorch_model.bin", weights_only=False)
    assert (own_copy / "marker").exists()  # it would have


def test_weights_of_the_older_form_are_read(own_copy: Path) -> None:
    from safetensors.torch import load_file

    expected = load_teacher("mask2former", own_copy, CPU).probabilities(coarse_image(40, 40))
    torch.save(load_file(own_copy / "model.safetensors"), own_copy / "pytorch_model.bin")
    (own_copy / "model.safetensors").unlink()
    torch.testing.assert_close(load_teacher("mask2former", own_copy, CPU).probabilities(coarse_image(40, 40)), expected)
    with pytest.raises(pickle.UnpicklingError):
        pickle.loads(b"not a pickle")


def test_a_model_of_the_hubs_cache(models: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(
        InputError, match=r"a/b: neither a folder nor a model in the hub's cache; fetch it first \(hf d"
    ):
        local_folder("a/b")
    with pytest.raises(InputError, match="no such: name!: neither a folder"):
        local_folder("no such: name!")
    snapshot = tmp_path / "models--a--b" / "snapshots" / ("0" * 40)
    shutil.copytree(models["mask2former"], snapshot)
    (tmp_path / "models--a--b" / "refs").mkdir()
    (tmp_path / "models--a--b" / "refs" / "main").write_text("0" * 40)
    assert local_folder("a/b") == snapshot
    assert local_folder(str(tmp_path)) == tmp_path


def test_parts_of_a_model(models: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("")
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(InputError, match="holds no weights"):
        parts_of(tmp_path)
    names = [path.name for path in parts_of(models["oneformer"])]
    assert names[:2] == ["config.json", "model.safetensors"] and names == sorted(names)


def test_without_transformers_the_extra_is_named(models: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(InputError, match=r"this teacher needs the extra 'train': pip install 'lidar2pano\[train\]'"):
        load_teacher("mask2former", models["mask2former"], CPU)
    with pytest.raises(InputError, match=r"pip install 'lidar2pano\[train\]'"):
        local_folder("a/b")
