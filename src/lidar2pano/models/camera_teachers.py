"""Networks for labels of camera images: SD-Net at its scales; Mask2Former and OneFormer of the package `transformers`.

Papers    Cheng et al.: Masked-attention Mask Transformer for Universal Image Segmentation, 2022 (arXiv:2112.01527);
          Jain et al.: OneFormer: One Transformer to Rule Universal Image Segmentation, 2023 (arXiv:2211.06220).
The latter two answer with queries, each a class and a mask; a pixel's score for a class is the sum over the queries of
class probability times mask probability (Cheng et al. 2021, arXiv:2107.06278, section 3.4, semantic inference).
Deviates  from the image processors of `transformers`: pictures are taken at their own size times the scales, not
          squeezed into a fixed one, and no torchvision is needed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pad

from lidar2pano.errors import InputError, require_extra
from lidar2pano.formats.json_files import read_json, validated
from lidar2pano.geometry.projection import check_normalisation
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.labels import CITYSCAPES
from lidar2pano.models.card import Card

# model_type -> class of transformers
MODEL_TYPES: dict[str, str] = {
    "mask2former": "Mask2FormerForUniversalSegmentation",
    "oneformer": "OneFormerForUniversalSegmentation",
}
STRIDE = 32  # of the coarsest features of the backbones
WEIGHTS = ("*.safetensors", "*.bin")
SETTINGS = ("*.json", "*.txt")
TASK = "the task is semantic"  # input of OneFormer


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageNormalisation:
    """Means and deviations of the channels of RGB pictures in [0, 1]; the defaults are those of ImageNet."""

    mean: tuple[float, ...] = (0.485, 0.456, 0.406)
    deviation: tuple[float, ...] = (0.229, 0.224, 0.225)

    def __post_init__(self) -> None:
        """Refuse other than three numbers each, and non-positive deviations (ValueError)."""
        if len(self.mean) != 3 or len(self.deviation) != 3:
            raise ValueError("normalisation needs a mean and a positive deviation for each of 3 channels")
        check_normalisation(self.mean, self.deviation)

    def __call__(self, images: Tensor) -> Tensor:
        """(..., 3, h, w) uint8 RGB -> float32, normalised."""
        mean = torch.tensor(self.mean, device=images.device)[:, None, None]
        deviation = torch.tensor(self.deviation, device=images.device)[:, None, None]
        return (images.float() / 255 - mean) / deviation

    def as_dict(self) -> dict[str, list[float]]:
        """Return the card's field `normalisation`."""
        return {"mean": list(self.mean), "deviation": list(self.deviation)}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraSegmenter:
    """A camera network with the scales to look at and the normalisation it was trained on.

    network    SdNet: (1, 3, h, w) and the scales -> (1, 19, h, w) logits.
    normalise  of its pictures.
    scales     sizes of the picture, as factors with 1.0 among them (published scripts: 0.5, 1, 2);
               None: the network's own.
    """

    network: nn.Module
    normalise: ImageNormalisation
    scales: tuple[float, ...] | None = None

    @classmethod
    def from_card(cls, network: nn.Module, card: Card, scales: tuple[float, ...] | None = None) -> CameraSegmenter:
        """Make the segmenter of a weight file: `network, card = load(path, expect="sdnet")`.

        scales  as above.
        A card of another label set raises InputError.
        """
        if card.labels != CITYSCAPES.name:
            raise InputError(
                f"weights of network {card.network!r} speak {card.labels!r}, not {CITYSCAPES.name!r}: "
                "they cannot label cameras; name others"
            )
        normalise = validated(ImageNormalisation, card.normalisation, "the card's normalisation")
        return cls(network=network, normalise=normalise, scales=scales)

    @torch.inference_mode()
    def probabilities(self, image: np.ndarray) -> Tensor:
        """Probabilities (19, h, w) float32 on the network's device, of a picture (h, w, 3) uint8 RGB of any size.

        The whole picture is looked at at once, since OCR gathers every class over all of it: at scales 0.5, 1 and 2
        the published network takes 3 GiB for KITTI's 376 x 1241 pixels in float32, 2 GiB in bfloat16.
        Another kind of array raises ValueError.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise ValueError(f"a picture is (h, w, 3) uint8 RGB, got {image.shape} {image.dtype}")
        device = next(self.network.parameters()).device
        pixels = torch.from_numpy(np.array(image, order="C")).to(device)  # a copy: pictures may be read-only
        x = self.normalise(pixels.movedim(2, 0))[None]
        with fast_arithmetic(device):
            logits = self.network(x.contiguous(memory_format=torch.channels_last), self.scales)[0]
        return logits.float().softmax(0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaskSegmenter:
    """A network of queries.

    network    of `transformers`: pixel_values (1, 3, H, W) -> class logits (1, Q, K + 1), mask logits (1, Q, H', W').
    classes    (19,) int64: the network's class for every Cityscapes train id.
    normalise  of its pictures.
    scales     sizes of the picture, as factors; their answers are averaged.
    task       (1, T) tokens of the task (OneFormer); None for a network without one.
    """

    network: nn.Module
    classes: Tensor
    normalise: ImageNormalisation
    scales: tuple[float, ...] = (1.0,)
    task: Tensor | None = None

    @torch.inference_mode()
    def probabilities(self, image: np.ndarray) -> Tensor:
        """Probabilities (19, h, w) float32 on the network's device, of a picture (h, w, 3) uint8 RGB.

        Probability of no query, or of classes other than Cityscapes', goes to all 19 alike.
        """
        x = self.normalise(torch.from_numpy(image).to(self.classes.device).movedim(2, 0))[None]
        size = image.shape[0], image.shape[1]
        return torch.stack([self._at(scale, x, size) for scale in self.scales]).mean(0)

    def _at(self, scale: float, x: Tensor, size: tuple[int, int]) -> Tensor:
        rows, columns = (max(round(side * scale), 1) for side in size)
        if (rows, columns) != size:
            x = interpolate(x, (rows, columns), mode="bilinear", align_corners=False, antialias=scale < 1)
        x = pad(x, (0, -columns % STRIDE, 0, -rows % STRIDE), mode="replicate")
        answer = self.network(pixel_values=x, **({} if self.task is None else {"task_inputs": self.task}))
        masks = interpolate(answer.masks_queries_logits, x.shape[-2:], mode="bilinear", align_corners=False)
        believed = answer.class_queries_logits[0].softmax(1)[:, :-1]  # the last class is "no object"
        scores = torch.einsum("qc,qhw->chw", believed, masks[0, :, :rows, :columns].sigmoid())
        scores = scores / scores.sum(0).clamp(min=1)
        probabilities = scores[self.classes]
        probabilities = probabilities + (1 - probabilities.sum(0)) / len(CITYSCAPES)
        if (rows, columns) == size:
            return probabilities
        return interpolate(probabilities[None], size, mode="bilinear", align_corners=False)[0]


CameraTeacher = CameraSegmenter | MaskSegmenter


def load_teacher(
    model_type: str, folder: Path, device: torch.device, scales: Sequence[float] = (1.0,)
) -> MaskSegmenter:
    """A teacher of MODEL_TYPES from a folder as `transformers` saves them; nothing is downloaded, nothing executed.

    Raises InputError when `transformers` is not installed, the folder does not hold such a network, weights are
    missing, or its classes have not all of Cityscapes'.
    """
    transformers = _transformers()
    settings = _json(folder / "config.json")
    if settings.get("model_type") != model_type:
        raise InputError(f"{folder}: holds a {settings.get('model_type')!r}, not a {model_type!r}; name another folder")
    normalise = _normalisation(folder)
    options: dict[str, Any] = {"local_files_only": True, "output_loading_info": True, "dtype": torch.float32}
    if model_type == "oneformer":
        options["is_training"] = False  # its text encoder is for training only
    try:
        with _quiet(transformers):
            network, info = getattr(transformers, MODEL_TYPES[model_type]).from_pretrained(folder, **options)
            task = _task(transformers, folder, network.config.task_seq_len) if model_type == "oneformer" else None
    except Exception as error:  # a broken file can break it anywhere
        reason = (str(error) or type(error).__name__).strip().splitlines()[0]
        raise InputError(f"{folder}: cannot be loaded as a {model_type} ({reason}); fetch it again") from error
    if missing := sorted(info["missing_keys"]):
        raise InputError(f"{folder}: {len(missing)} weights are missing, the first is {missing[0]!r}; fetch it again")
    classes = torch.tensor(cityscapes_classes(network.config.id2label, folder), device=device)
    network = network.to(device).eval()
    return MaskSegmenter(
        network=network,
        classes=classes,
        normalise=normalise,
        scales=tuple(scales),
        task=None if task is None else task.to(device),
    )


def cityscapes_classes(names: dict[int, str], source: object = "the model") -> list[int]:
    """The id of each of Cityscapes' 19 classes among a model's `names`; case, "-" and "_" do not matter.

    Raises InputError with the classes missing in the model, `source`.
    """
    ids = {" ".join(name.lower().replace("-", " ").replace("_", " ").split()): int(i) for i, name in names.items()}
    if missing := [name for name in CITYSCAPES.classes if name not in ids]:
        raise InputError(
            f"{source}: has no class {', '.join(map(repr, missing))}; name a model that was trained on Cityscapes"
        )
    return [ids[name] for name in CITYSCAPES.classes]


def local_folder(name: str) -> Path:
    """The folder of a model: a path, or its place in the hub's cache. InputError without one."""
    if Path(name).is_dir():
        return Path(name)
    _transformers()
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(name, local_files_only=True))
    except Exception as error:  # a bad name and an empty cache are errors of several kinds
        raise InputError(
            f"{name}: neither a folder nor a model in the hub's cache; fetch it first (hf download {name})"
        ) from error


def parts_of(folder: Path) -> list[Path]:
    """The files of a model: settings and weights, by name. InputError without weights."""
    files = {path for ending in (*WEIGHTS, *SETTINGS) for path in folder.glob(ending) if path.is_file()}
    if not any(path.match(ending) for path in files for ending in WEIGHTS):
        raise InputError(f"{folder}: holds no weights (*.safetensors, *.bin); name the folder of a whole model")
    return sorted(files)


def _transformers() -> Any:  # noqa: ANN401
    with require_extra("train", "this teacher"):
        import transformers
    return transformers


@contextmanager
def _quiet(transformers: Any) -> Iterator[None]:  # noqa: ANN401
    """Silence the reports and bars of `transformers` on stderr: faults are told by us."""
    messages = transformers.utils.logging
    level, bars = messages.get_verbosity(), messages.is_progress_bar_enabled()
    messages.set_verbosity(messages.CRITICAL)
    messages.disable_progress_bar()
    try:
        yield
    finally:
        messages.set_verbosity(level)
        if bars:
            messages.enable_progress_bar()


def _json(path: Path) -> dict[str, Any]:
    content = read_json(path, "name the folder of a whole model")
    if not isinstance(content, dict):
        raise InputError(f"{path}: are no settings of a model; name the folder of a whole one")
    return content


def _normalisation(folder: Path) -> ImageNormalisation:
    """Mean and deviation of the model's pictures, from the settings of its image processor."""
    path = folder / "preprocessor_config.json"
    if path.is_file():
        settings = _json(path)
    else:
        path = folder / "processor_config.json"  # newer versions save image processor and tokenizer together
        settings = _json(path).get("image_processor", {})
    try:
        mean, deviation = (tuple(float(v) for v in settings[name]) for name in ("image_mean", "image_std"))
        return ImageNormalisation(mean=mean, deviation=deviation)
    except (KeyError, TypeError, ValueError):
        fault = "has no image_mean and image_std of three channels; fetch the model again"
        raise InputError(f"{path}: {fault}") from None


def _task(transformers: Any, folder: Path, length: int) -> Tensor:  # noqa: ANN401
    """(1, length) float32: OneFormer's task in its own tokens, zero after the end."""
    tokenizer = transformers.AutoTokenizer.from_pretrained(folder, local_files_only=True)
    tokens = tokenizer([TASK], padding="max_length", max_length=length, truncation=True, return_tensors="pt")
    return (tokens["input_ids"] * tokens["attention_mask"]).float()
