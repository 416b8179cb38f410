"""Take the pixel shuffles out of a scene painter: without_shuffles.py WEIGHTS OUT

The four convolutions that made the four pixels of a larger raster become their mean, which makes all four. The weave
that they painted goes, and some detail; a training that begins from OUT brings detail back.
"""

import sys
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.nn.utils.fusion import fuse_conv_bn_weights

from lidar2pano.models import build
from lidar2pano.models.card import read_card, save

EPS = 1e-5  # of batch norms


def merged(state: dict[str, Tensor], part: str) -> dict[str, Tensor]:
    """The tensors of `part`, a convolution and its norm, each four outputs become one: the norms become affine maps."""
    conv, norm = f"{part}.0.0", f"{part}.0.1"
    statistics = state[f"{norm}.running_mean"], state[f"{norm}.running_var"], EPS
    scale = state[f"{norm}.weight"], state[f"{norm}.bias"]
    fused = fuse_conv_bn_weights(state[f"{conv}.weight"], state[f"{conv}.bias"], *statistics, *scale)
    weight, bias = (tensor.detach().unflatten(0, (-1, 4)).mean(1) for tensor in fused)
    ones = torch.ones_like(bias)
    return {
        f"{part}.0.weight": weight,
        f"{part}.0.bias": bias,
        f"{part}.1.weight": ones,
        f"{part}.1.bias": torch.zeros_like(bias),
        f"{part}.1.running_mean": torch.zeros_like(bias),
        f"{part}.1.running_var": ones - EPS,
        f"{part}.1.num_batches_tracked": state[f"{norm}.num_batches_tracked"],
    }


def main(weights: str, out: str) -> None:
    card, state = read_card(weights), load_file(weights)
    kept = {name: tensor for name, tensor in state.items() if not name.startswith(("up0.", "up1."))}
    network = build("scene-painter", **card.settings)
    network.load_state_dict(kept | merged(state, "up0") | merged(state, "up1"))
    save(Path(out), network, card)


if __name__ == "__main__":
    main(*sys.argv[1:])
