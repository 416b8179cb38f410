"""The networks by name, and the one function to build them."""

from __future__ import annotations

from torch import nn

from lidar2pano.errors import InputError, closest
from lidar2pano.models.autoencoder import Autoencoder
from lidar2pano.models.baselines import PatchGan, Pix2Pix, ScUnet
from lidar2pano.models.frozen_features import ProjectedCritic
from lidar2pano.models.latent_painter import LatentPainter
from lidar2pano.models.salsanext import SalsaNext, Titan, TitanCritic, TitanNext
from lidar2pano.models.sdnet import SdNet
from lidar2pano.models.titan_pano import TitanPano
from lidar2pano.models.vid2vid import ImageCritic, TemporalCritic, Vid2Vid, Vid2VidSingle

MODELS: dict[str, type[nn.Module]] = {
    "salsanext": SalsaNext,
    "titan": Titan,
    "titan-critic": TitanCritic,
    "titan-next": TitanNext,
    "titan-pano": TitanPano,
    "autoencoder": Autoencoder,
    "latent-painter": LatentPainter,
    "projected-critic": ProjectedCritic,
    "vid2vid": Vid2Vid,
    "vid2vid-single": Vid2VidSingle,
    "vid2vid-image-critic": ImageCritic,
    "vid2vid-temporal-critic": TemporalCritic,
    "pix2pix": Pix2Pix,
    "pix2pix-critic": PatchGan,
    "scunet": ScUnet,
    "sdnet": SdNet,
}


def settings_of(network: type[nn.Module]) -> set[str]:
    """Names of a network's settings: its parameters."""
    return network.__init__.__annotations__.keys() - {"return"}


def build(name: str, **settings: object) -> nn.Module:
    """Build a network of MODELS with fresh weights; InputError for an unknown name and for impossible settings.

    >>> build("salsanext", classes=20)
    """
    if name not in MODELS:
        raise InputError(f"no network {name!r}{closest(name, MODELS)}")
    names = settings_of(MODELS[name])
    if unknown := [setting for setting in settings if setting not in names]:
        raise InputError(f"network {name!r} has no setting {unknown[0]!r}{closest(unknown[0], names)}")
    try:
        network = MODELS[name](**settings)
    except InputError:
        raise
    except (TypeError, ValueError, RuntimeError, ArithmeticError, LookupError, AttributeError) as error:
        raise InputError(
            f"network {name!r} cannot be built with settings {settings} ({type(error).__name__})"
        ) from None
    if empty := next((key for key, weight in network.named_parameters() if not weight.numel()), None):
        raise InputError(f"network {name!r} with settings {settings} has nothing in {empty!r}; choose larger sizes")
    return network
