"""Weights that the authors of the networks published: their torch checkpoints as state dicts of our networks.

Our networks carry the published names, so nothing is renamed; but every tensor of the file must be used up. Only
weights are read: nothing in the file is executed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from lidar2pano.errors import InputError, closest
from lidar2pano.geometry.images import Normalisation
from lidar2pano.labels import CITYSCAPES, COMMON14, SEMANTIC_KITTI
from lidar2pano.models import build, published_settings
from lidar2pano.models.camera_segmenter import Colours
from lidar2pano.models.card import Card, mismatch
from lidar2pano.models.published_files import read_table, scale_files
from lidar2pano.sensors import VIEWS

_POINTS = Normalisation()
_COUNTER = "num_batches_tracked"


def _centred(mean: Sequence[float], deviation: Sequence[float]) -> dict[str, list[float]]:
    return {"mean": list(mean), "deviation": list(deviation)}


_SIGNED = _centred([0.5] * 3, [0.5] * 3)  # RGB in [0, 1] -> [-1, 1]


@dataclass(frozen=True, kw_only=True)
class Published:
    """Where users find a network's published weights (`upstream`, an address) and on which terms (`licence`).

    data           what they were trained on.
    view           name in VIEWS of the range image that the network reads; None where it reads pictures.
    labels         name of the label set that the output channels speak; None for pictures and scores.
    normalisation  of its input, as cards write it.
    settings       finds out how the network was built.
    by_scale       whether it is published as one file per spatial scale.
    old            whether files of torch before 0.4.1 are about, which wrote other entries for norms (`_modern`).
    """

    upstream: str
    licence: str
    data: str
    view: str | None
    labels: str | None
    normalisation: dict[str, list[float]]
    settings: Callable[[published_settings.Shapes], dict[str, Any]] = published_settings.fixed
    by_scale: bool = False
    old: bool = False


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
    settings=published_settings.vid2vid,
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
    settings=published_settings.pix2pix,
    old=True,
)
_CRITIC = replace(_VID2VID, settings=published_settings.vid2vid_critic, by_scale=False)
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
        normalisation=Colours().as_dict(),
        settings=published_settings.sdnet,
    ),
    "vid2vid": _VID2VID,
    "vid2vid-single": replace(_VID2VID, settings=published_settings.vid2vid_single, by_scale=False),
    "vid2vid-image-critic": _CRITIC,
    "vid2vid-temporal-critic": _CRITIC,
    "pix2pix": _PIX2PIX,
    "pix2pix-critic": replace(_PIX2PIX, settings=published_settings.pix2pix_critic),
}


class Imported(NamedTuple):
    """Published weights: for build(network, **settings), the state dict, float32 on the CPU."""

    settings: dict[str, Any]
    state: dict[str, Tensor]


def import_published(paths: Path | str | Sequence[Path | str], network: str) -> Imported:
    """The weights in a published checkpoint, and how the network was built.

    paths    torch file: a state dict, or a dict with one under "state_dict"; keys may begin with "module.". vid2vid's
             generator is one file per spatial scale, in any order, or the folder that holds them.
    network  name in PUBLISHED.
    A file that is absent, damaged, hostile or of another network raises InputError; nothing in it is executed.
    """
    if network not in PUBLISHED:
        raise InputError(f"no published weights for network {network!r}{closest(network, PUBLISHED)}")
    published = PUBLISHED[network]
    files = _files(paths, published.by_scale, network)
    said = ", ".join(map(str, files))
    tables = [read_table(file) for file in files]
    ours = _joined(tables, said) if published.by_scale else tables[0]
    shapes = {key: tuple(value.shape) for key, value in ours.items() if isinstance(value, Tensor)}
    if empty := [key for key, shape in shapes.items() if 0 in shape]:
        raise InputError(f"{said} does not fit the published network {network!r}: {empty[0]!r} is empty")
    try:
        settings = published.settings(shapes)
        with torch.device("meta"):
            blank = build(network, **settings)
    except InputError as error:
        raise InputError(f"{said} does not fit the published network {network!r}: {error}") from None
    except (LookupError, ValueError, RuntimeError, TypeError, ArithmeticError, AttributeError, AssertionError):
        raise InputError(
            f"{said} is of another network than the published {network!r}; give the authors' file"
        ) from None
    wanted = blank.state_dict()
    if published.old:
        ours = _modern(ours, blank)
    if wrong := mismatch(ours, wanted):
        raise InputError(f"{said} does not fit the published network {network!r}: {wrong}; give the authors' file")
    state = cast("Mapping[str, Tensor]", ours)  # or they would not fit
    return Imported(settings, {key: state[key].detach().to(old.dtype).contiguous() for key, old in wanted.items()})


def published_card(network: str, file: str, settings: dict[str, Any]) -> Card:
    """The card of published weights.

    network  in PUBLISHED;  file: name of the checkpoint they come from;  settings: what it was built with.
    """
    published = PUBLISHED[network]
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


def _joined(tables: Sequence[Mapping[str, object]], said: str) -> dict[str, object]:
    """One table of a generator's scales, coarse to fine, keys of scale n behind "n."; InputError unless they are that.

    The coarsest has blocks that finer ones lack; those follow by their widths.
    """

    def width(table: Mapping[str, object]) -> int:
        first = table.get("model_down_seg.1.weight")
        return first.shape[0] if isinstance(first, Tensor) and first.ndim else 0

    coarse = [table for table in tables if any(key.startswith("model_res_img.") for key in table)]
    if len(coarse) != 1:
        raise InputError(
            f"{said}: {len(coarse)} of the files are the coarsest scale's (*_net_G0.pth); name one per scale"
        )
    finer = sorted((table for table in tables if table is not coarse[0]), key=width, reverse=True)
    return {f"{scale}.{key}": value for scale, table in enumerate(coarse + finer) for key, value in table.items()}


def _modern(ours: Mapping[str, object], blank: nn.Module) -> dict[str, object]:
    """A table as torch writes it today.

    Before 0.4.1 norms had no counter of batches: where a table has none at all, zeros are put in. Before 0.4 instance
    norms wrote statistics that they never used: those of norms that keep none are left out.
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
