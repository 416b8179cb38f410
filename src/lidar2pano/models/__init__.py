"""The networks by name, and the one function that builds them."""

from __future__ import annotations

import inspect
from importlib import import_module
from typing import TYPE_CHECKING

from lidar2pano.errors import InputError, closest

if TYPE_CHECKING:
    from torch import nn

# name -> module of this package and class in it; imported on first use, so that listing the names needs no torch
MODELS: dict[str, str] = {
    "salsanext": "salsanext:SalsaNext",
    "titan": "titan:Titan",
    "titan-critic": "titan_critic:TitanCritic",
    "titan-next": "titan_next:TitanNext",
    "titan-pano": "titan_pano:TitanPano",
    "painter": "painter:Painter",
    "scene-painter": "scene_painter:ScenePainter",
    "projected-critic": "projected_critic:ProjectedCritic",
    "patch-critic": "patch_critic:PatchCritic",
    "vid2vid": "vid2vid:Vid2Vid",
    "vid2vid-single": "vid2vid_single:Vid2VidSingle",
    "vid2vid-image-critic": "vid2vid_critics:ImageCritic",
    "vid2vid-temporal-critic": "vid2vid_critics:TemporalCritic",
    "pix2pix": "pix2pix:Pix2Pix",
    "pix2pix-critic": "pix2pix:PatchGan",
    "scunet": "scunet:ScUnet",
    "sdnet": "sdnet:SdNet",
}


def network_class(name: str) -> type[nn.Module]:
    """The class behind a name of MODELS; an unknown name raises InputError."""
    if name not in MODELS:
        raise InputError(f"no network {name!r}{closest(name, MODELS)}")
    module, _, class_name = MODELS[name].partition(":")
    return getattr(import_module(f"{__name__}.{module}"), class_name)


def build(name: str, **settings: object) -> nn.Module:
    """A network of MODELS with fresh weights; an unknown name or setting raises InputError.

    >>> build("salsanext", classes=20)
    """
    made_by = network_class(name)
    known = inspect.signature(made_by).parameters
    for setting in settings:
        if setting not in known:
            raise InputError(f"network {name!r} has no setting {setting!r}{closest(setting, known)}")
    return made_by(**settings)
