"""Weights published by the authors of the networks: their torch checkpoints as state dicts of our networks.

Our networks carry the published names, so nothing is renamed; but every tensor of the file must be used up. Only
weights are read: nothing in the file is executed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from lidar2pano.errors import InputError, closest
from lidar2pano.formats.torch_files import load_torch
from lidar2pano.geometry.projection import Normalisation
from lidar2pano.labels import CITYSCAPES, CITYSCAPES_IDS, COMMON14, SEMANTIC_KITTI
from lidar2pano.models import build
from lidar2pano.models.camera_teachers import ImageNormalisation
from lidar2pano.models.card import Card, mismatch
from lidar2pano.models.salsanext import IMAGE_SIZE
from lidar2pano.views import VIEWS

Shapes = Mapping[str, tuple[int, ...]]
CAR = CITYSCAPES_IDS.id_of("car")  # the one class painted apart by published street networks
_POINTS = Normalisation()
_COUNTER = "num_batches_tracked"


def _centred(mean: Sequence[float], deviation: Sequence[float]) -> dict[str, list[float]]:
    return {"mean": list(mean), "deviation": list(deviation)}


_SIGNED = _centred([0.5] * 3, [0.5] * 3)  # RGB in [0, 1] -> [-1, 1]


# How published networks were built, from the names and shapes of their weights: keyword arguments for `build`. Whether
# every key and shape fits is checked afterwards, against the described network. A missing key raises KeyError.


def sdnet(shapes: Shapes) -> dict[str, Any]:
    """SD-Net: classes and sizes; at its own scales, 0.5 and 1."""
    modules = [_count(shapes, rf"backbone\.stage{stage}\.\d+\.branches\.0\.0\.conv1\.weight") for stage in (2, 3, 4)]
    return {
        "classes": shapes["ocr.cls_head.weight"][0],
        "width": shapes["backbone.stage2.0.branches.0.0.conv1.weight"][0],
        "stem": shapes["backbone.conv1.weight"][0],
        "blocks": _count(shapes, r"backbone\.stage2\.0\.branches\.0\.\d+\.conv1\.weight"),
        "modules": modules,
        "context": shapes["ocr.conv3x3_ocr.0.weight"][0],
    }


def vid2vid(shapes: Shapes) -> dict[str, Any]:
    """vid2vid's generator, keys of scale n behind "n.".

    Norms use the statistics of their input, since the published test program never leaves training mode. The car is
    painted apart, the only choice published for streets; other label sets than Cityscapes' ids with such
    a branch raise InputError.
    """
    inputs, previous = shapes["0.model_down_seg.1.weight"][1], shapes["0.model_down_img.1.weight"][1]
    frames = previous // 3 + 1
    apart = any(key.startswith("0.indv_") for key in shapes)
    if inputs % frames or previous % 3:
        raise InputError(f"{inputs} label and {previous} picture channels are not those of whole frames")
    if apart and inputs // frames not in (len(CITYSCAPES_IDS), len(CITYSCAPES_IDS) + 1):
        raise InputError(
            f"it paints some of its {inputs // frames} label channels apart and does not say which; only networks of"
            f" Cityscapes' {len(CITYSCAPES_IDS)} ids can be imported with such a branch"
        )
    scales = 1 + max(int(key.partition(".")[0]) for key in shapes if key[:1].isdigit())
    blocks = [
        _count(shapes, rf"{branch}\.\d+\.conv_block\.1\.weight")
        for branch in (r"0\.model_down_seg", r"0\.model_res_img", r"1\.model_up_img")
    ]
    return {
        "channels": inputs // frames,
        "widths": [shapes[f"{scale}.model_down_seg.1.weight"][0] for scale in range(scales)],
        "downsamplings": _convolutions(shapes, r"0\.model_down_seg\.\d+\.weight") - 1,
        "blocks": [blocks[0] + blocks[1], blocks[2]],
        "foreground": [CAR] if apart else [],
        "frames": frames,
        "batch_statistics": True,
    }


def vid2vid_single(shapes: Shapes) -> dict[str, Any]:
    """vid2vid's first-frame network; its norms, too, use the statistics of their input."""
    enhancers = _count(shapes, r"model\d+_1\.1\.weight")
    finest = shapes[f"model{enhancers}_1.1.weight" if enhancers else "model.1.weight"]
    layers = _convolutions(shapes, r"model\.\d+\.weight")  # one, as many down as up, and without enhancers a head
    return {
        "classes": finest[1],
        "width": finest[0],
        "downsamplings": (layers - 1) // 2,
        "blocks": _count(shapes, r"model\.\d+\.conv_block\.1\.weight"),
        "enhancers": enhancers,
        "local_blocks": _count(shapes, r"model1_2\.\d+\.conv_block\.1\.weight"),
        "batch_statistics": True,
    }


def vid2vid_critic(shapes: Shapes) -> dict[str, Any]:
    """vid2vid's critics of pictures and of clips."""
    scales = _count(shapes, r"scale\d+_layer0\.0\.weight")
    width, channels = shapes[f"scale{scales - 1}_layer0.0.weight"][:2]  # the last one sees the whole picture
    layers = _count(shapes, r"scale0_layer\d+\.0\.weight") - 2
    return {"channels": channels, "width": width, "layers": layers, "scales": scales}


def pix2pix(shapes: Shapes) -> dict[str, Any]:
    """Pix2Pix' U-Net. Batch norms use the statistics of the batch, as the published test command does.

    Convolutions have a bias before instance norms only.
    """
    width, inputs = shapes["model.model.0.weight"][:2]
    instance = "model.model.0.bias" in shapes
    return {
        "inputs": inputs,
        "outputs": shapes["model.model.3.weight"][1],
        "width": width,
        "depth": 1 + _count(shapes, r"model\.model\.1(\.model\.3)*\.model\.1\.weight"),
        "norm": "instance" if instance else "batch",
        "batch_statistics": not instance,
    }


def pix2pix_critic(shapes: Shapes) -> dict[str, Any]:
    """Pix2Pix' PatchGAN."""
    width, channels = shapes["model.0.weight"][:2]
    layers = _convolutions(shapes, r"model\.\d+\.weight") - 2
    return {
        "channels": channels,
        "width": width,
        "layers": layers,
        "norm": "instance" if "model.2.bias" in shapes else "batch",
    }


def fixed(shapes: Shapes) -> dict[str, Any]:  # noqa: ARG001 whatever they are
    """A network published in one size only."""
    return {}


def _count(shapes: Shapes, pattern: str) -> int:
    """Count the keys of a pattern."""
    return sum(re.fullmatch(pattern, key) is not None for key in shapes)


def _convolutions(shapes: Shapes, pattern: str) -> int:
    """Count the weights with four dimensions and keys of a pattern."""
    return _count({key: shape for key, shape in shapes.items() if len(shape) == 4}, pattern)


@dataclass(frozen=True, kw_only=True)
class Published:
    """Address (`upstream`) and terms (`licence`) of a network's published weights.

    data           of their training.
    view           name in VIEWS of the network's range image; None for pictures.
    labels         name of the label set of the output channels; None for pictures and scores.
    normalisation  of its input, as cards write it.
    settings       finds out how the network was built.
    by_scale       whether it is published as one file per spatial scale.
    old            whether files of torch before 0.4.1 are about, with other entries for norms (`_modern`).
    """

    upstream: str
    licence: str
    data: str
    view: str | None
    labels: str | None
    normalisation: dict[str, list[float]]
    settings: Callable[[Shapes], dict[str, Any]] = fixed
    by_scale: bool = False
    old: bool = False


RANGE_VIEW_INPUTS = (5, 5 + len(SEMANTIC_KITTI))  # channels of a Pix2Pix on the range view
_TITAN = Published(
    upstream="https://github.com/TiagoCortinhal/TITAN-NET",
    licence="none stated for the weights; trained on SemanticKITTI (CC BY-NC-SA 4.0)",
    data="SemanticKITTI",
    view="titan-front",
    labels=COMMON14.name,
    normalisation=_centred(_POINTS.mean, _POINTS.deviation),
)
_VID2VID = Published(
    upstream="https://github.com/NVIDIA/vid2vid",
    licence="CC BY-NC-SA 4.0; trained on Cityscapes",
    data="Cityscapes",
    view=None,
    labels=None,
    normalisation=_SIGNED,
    settings=vid2vid,
    by_scale=True,
    old=True,
)
_PIX2PIX = Published(
    upstream="https://github.com/junyanz/pytorch-CycleGAN-and-pix2pix",
    licence="BSD-2-Clause for the code; that of the data for the weights",
    data="not stated in the file",
    view=None,
    labels=None,
    normalisation=_SIGNED,
    settings=pix2pix,
    old=True,
)
_CRITIC = replace(_VID2VID, settings=vid2vid_critic, by_scale=False)
PUBLISHED: dict[str, Published] = {
    "salsanext": replace(
        _TITAN,
        upstream="https://github.com/TiagoCortinhal/SalsaNext",
        licence="MIT for the code; trained on SemanticKITTI (CC BY-NC-SA 4.0)",
        view="hdl64e",
        labels=SEMANTIC_KITTI.name,
    ),
    "titan": _TITAN,
    "titan-critic": replace(_TITAN, labels=None),
    "sdnet": Published(
        upstream="https://github.com/NVIDIA/semantic-segmentation",
        licence="BSD-3-Clause for the code; trained on Cityscapes, NC (not for commercial use)",
        data="Cityscapes",
        view=None,
        labels=CITYSCAPES.name,
        normalisation=ImageNormalisation().as_dict(),
        settings=sdnet,
    ),
    "vid2vid": _VID2VID,
    "vid2vid-single": replace(_VID2VID, settings=vid2vid_single, by_scale=False),
    "vid2vid-image-critic": _CRITIC,
    "vid2vid-temporal-critic": _CRITIC,
    "pix2pix": _PIX2PIX,
    "pix2pix-critic": replace(_PIX2PIX, settings=pix2pix_critic),
}


class Imported(NamedTuple):
    """Published weights: for build(network, **settings), the state dict, float32 on the CPU."""

    settings: dict[str, Any]
    state: dict[str, Tensor]


def import_published(paths: Path | str | Sequence[Path | str], network: str) -> Imported:
    """The weights in a published checkpoint, and how the network was built.

    paths    torch file: a state dict, or a dict with one under "state_dict"; keys may begin with "module.". vid2vid's
             generator is one file per spatial scale, in any order, or their folder.
    network  name in PUBLISHED.
    An absent, damaged or hostile file, or one of another network, raises InputError; nothing in it is executed.
    """
    if network not in PUBLISHED:
        raise InputError(f"no published weights for network {network!r}{closest(network, PUBLISHED)}")
    published = PUBLISHED[network]
    files = _files(paths, published.by_scale, network)
    names = ", ".join(map(str, files))
    tables = [read_table(file) for file in files]
    ours = _joined(tables, names) if published.by_scale else tables[0]
    shapes = {key: tuple(value.shape) for key, value in ours.items() if isinstance(value, Tensor)}
    if empty := [key for key, shape in shapes.items() if 0 in shape]:
        raise InputError(f"{names} does not fit the published network {network!r}: {empty[0]!r} is empty")
    try:
        settings = published.settings(shapes)
        with torch.device("meta"):
            blank = build(network, **settings)
    except InputError as error:
        raise InputError(f"{names} does not fit the published network {network!r}: {error}") from None
    except (LookupError, ValueError, RuntimeError, TypeError, ArithmeticError, AttributeError, AssertionError):
        raise InputError(
            f"{names} is of another network than the published {network!r}; give the authors' file"
        ) from None
    expected = blank.state_dict()
    if published.old:
        ours = _modern(ours, blank)
    if wrong := mismatch(ours, expected):
        raise InputError(f"{names} does not fit the published network {network!r}: {wrong}; give the authors' file")
    state = cast("Mapping[str, Tensor]", ours)  # or they would not fit
    return Imported(settings, {key: state[key].detach().to(old.dtype).contiguous() for key, old in expected.items()})


def published_card(network: str, file: str, settings: dict[str, Any]) -> Card:
    """The card of published weights.

    network  in PUBLISHED;  file: name of their checkpoint;  settings: of the network.
    """
    published = PUBLISHED[network]
    if network == "pix2pix" and settings.get("inputs") in RANGE_VIEW_INPUTS:
        # trained as the paper does, in TITAN-Net's place: the range view with or without its classes
        labels = COMMON14.name if settings.get("outputs") == len(COMMON14) else None
        published = replace(published, view=_TITAN.view, normalisation=_TITAN.normalisation, labels=labels)
        settings = {**settings, "size": IMAGE_SIZE}
    return Card(
        network=network,
        settings=settings,
        labels=published.labels,
        views={"input": VIEWS[published.view].as_dict()} if published.view else {},
        normalisation=published.normalisation,
        recipe=f"published ({file})",
        data=published.data,
        licence=published.licence,
        upstream=published.upstream,
    )


def _files(paths: Path | str | Sequence[Path | str], by_scale: bool, network: str) -> list[Path]:
    files = [Path(path) for path in ([paths] if isinstance(paths, Path | str) else paths)]
    if by_scale:
        return [file for path in files for file in (scale_files(path) if path.is_dir() else [path])]
    if len(files) != 1:
        raise InputError(f"{', '.join(map(str, files))}: {network!r} is published as one file; name that one")
    return files


def _joined(tables: Sequence[Mapping[str, object]], names: str) -> dict[str, object]:
    """One table of a generator's scales, coarse to fine, keys of scale n behind "n."; InputError otherwise.

    The coarsest has further blocks; finer ones follow by their widths.
    """

    def width(table: Mapping[str, object]) -> int:
        first = table.get("model_down_seg.1.weight")
        return first.shape[0] if isinstance(first, Tensor) and first.ndim else 0

    coarse = [table for table in tables if any(key.startswith("model_res_img.") for key in table)]
    if len(coarse) != 1:
        raise InputError(
            f"{names}: {len(coarse)} of the files are the coarsest scale's (*_net_G0.pth); name one per scale"
        )
    finer = sorted((table for table in tables if table is not coarse[0]), key=width, reverse=True)
    return {f"{scale}.{key}": value for scale, table in enumerate(coarse + finer) for key, value in table.items()}


def _modern(ours: Mapping[str, object], blank: nn.Module) -> dict[str, object]:
    """A table as torch writes it today.

    Before 0.4.1 norms had no counter of batches: a table without any gets zeros. Before 0.4 instance
    norms wrote unused statistics: those of norms without any are left out.
    """
    idle = {
        f"{name}.{entry}"
        for name, part in blank.named_modules()
        if isinstance(part, nn.InstanceNorm2d) and not part.track_running_stats
        for entry in ("running_mean", "running_var", _COUNTER)
    }
    kept = {key: value for key, value in ours.items() if key not in idle}
    counters = [key for key in blank.state_dict() if key.endswith(f".{_COUNTER}")]
    if not any(key.endswith(f".{_COUNTER}") for key in kept):
        kept |= {key: torch.zeros((), dtype=torch.int64) for key in counters}
    return kept


class _Bystander:
    """Stand-in for objects other than weights in a checkpoint: takes anything and keeps nothing."""

    def __new__(cls, *_: object) -> _Bystander:
        return object.__new__(cls)

    def __init__(self, *_: object) -> None:
        """Keep nothing."""

    def __setstate__(self, state: object) -> None:
        """Keep nothing."""


class _PlainDict(_Bystander):
    def __new__(cls, *_: object) -> dict:
        return {}


def _stand_in(name: str, base: type[_Bystander] = _Bystander) -> type:
    module, _, last = name.rpartition(".")
    return type(last, (base,), {"__module__": module, "__qualname__": last})


# SalsaNext's checkpoints hold the whole warm-up scheduler (common/warmupLR.py) and, through it, the optimizer; SD-Net's
# hold the score of their epoch as a number of numpy's. Torch refuses such files because of these names; each is read as
# an object without content.
_BYSTANDERS: list[Callable | tuple[Callable, str]] = [
    _stand_in("torch.optim.lr_scheduler.CyclicLR"),
    _stand_in("torch.optim.sgd.SGD"),
    _stand_in("builtins.getattr"),  # of a bound method, scheduler.scale_fn
    _stand_in("builtins.dict"),  # the factory of the next
    _stand_in("collections.defaultdict", _PlainDict),
    _stand_in("numpy.core.multiarray.scalar"),
    _stand_in("numpy._core.multiarray.scalar"),  # its name since numpy 2
    _stand_in("numpy.dtype"),
]


def read_table(path: Path) -> dict[str, object]:
    """The table of weights in a torch file: a state dict, or one under "state_dict"; "module." is taken off its keys.

    Raises InputError for an absent, damaged or hostile file, or one without such a table; nothing in it is executed.
    """
    if not path.is_file():
        raise InputError(f"no checkpoint file {path}; check the path")
    try:
        with torch.serialization.safe_globals(_BYSTANDERS):
            table = load_torch(path)
    except Exception:  # a broken or hostile file can break torch's restricted reader anywhere
        raise InputError(
            f"{path} cannot be read as weights: it is cut off, no torch checkpoint, or holds more than weights; "
            "fetch it again from its authors"
        ) from None
    if isinstance(table, Mapping):
        table = table.get("state_dict", table)
    if not isinstance(table, Mapping) or not all(isinstance(key, str) for key in table):
        raise InputError(f"{path} has no table of weights; give the checkpoint file that the authors published")
    bare = {key.removeprefix("module."): value for key, value in table.items()}
    if len(bare) < len(table):
        raise InputError(f"{path} has the same weights twice, with and without 'module.'; give the authors' file")
    return bare


def scale_files(folder: Path) -> list[Path]:
    """Vid2vid's files of one generator in a folder, "<epoch>_net_G<scale>.pth" per scale; of several, "latest".

    Raises InputError without any, or with several candidates.
    """
    epochs: dict[str, list[Path]] = {}
    for path in sorted(folder.glob("*_net_G[0-9].pth")):
        epochs.setdefault(re.sub(r"_net_G\d\.pth$", "", path.name), []).append(path)
    if not epochs:
        raise InputError(f"{folder}: holds no *_net_G0.pth; name the files of the generator")
    if len(epochs) > 1 and "latest" not in epochs:
        raise InputError(f"{folder}: holds generators of several epochs ({', '.join(epochs)}); name the files of one")
    return epochs["latest"] if "latest" in epochs else next(iter(epochs.values()))
