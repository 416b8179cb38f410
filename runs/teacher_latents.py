"""Latents of photographs by a published tiny autoencoder's encoder, for the recipe `autoencoder`.

    python runs/teacher_latents.py ENCODER OUT ROOT:SPLIT...

ENCODER  taef2_encoder.pth (MIT): a list of layers, `N.weight` (a convolution; without a bias it halves the raster),
         `N.conv.{0,2,4}.*` (a residual block) and `N.pool.{0,1,3}.*` (a branch normalised over the raster, only
         where a block has it). Nothing in it is executed and nothing of it is shipped.
OUT      folder; gets <key>.safetensors per photograph, float16. Files that are there are kept.
"""

import sys
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.nn.functional import conv2d, group_norm, relu

from lidar2pano.data.photographs import PhotographDataset, as_signed, photograph_key
from lidar2pano.formats.torch_files import load_torch


def block(layers: dict[str, Tensor], number: int, x: Tensor) -> Tensor:
    """Apply a residual block."""
    if f"{number}.pool.0.weight" in layers:
        wide = conv2d(x, layers[f"{number}.pool.0.weight"])
        wide = group_norm(wide, 4, layers[f"{number}.pool.1.weight"], layers[f"{number}.pool.1.bias"])
        x = x + conv2d(relu(wide), layers[f"{number}.pool.3.weight"])
    hidden = x
    for layer in (0, 2, 4):
        hidden = conv2d(
            hidden, layers[f"{number}.conv.{layer}.weight"], layers[f"{number}.conv.{layer}.bias"], padding=1
        )
        hidden = relu(hidden) if layer < 4 else hidden
    return relu(hidden + x)


def encode(layers: dict[str, Tensor], picture: Tensor) -> Tensor:
    """Return latents (B, 32, H/8, W/8) of a picture (B, 3, H, W) in [0, 1]."""
    x = picture
    for number in range(1 + max(int(key.split(".")[0]) for key in layers)):
        if f"{number}.weight" in layers:
            bias = layers.get(f"{number}.bias")
            x = conv2d(x, layers[f"{number}.weight"], bias, stride=2 if bias is None else 1, padding=1)
        elif f"{number}.conv.0.weight" in layers:
            x = block(layers, number, x)
    return x


def main(encoder: str, out: str, *splits: str) -> None:
    """Write the latents of all photographs of some splits."""
    layers = {key: value.float() for key, value in load_torch(encoder).items()}
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    photographs = PhotographDataset(Path(), splits, 8)
    for index in range(len(photographs)):
        image = photographs.photograph(index)
        file = folder / f"{photograph_key(image)}.safetensors"
        if file.is_file():
            continue
        picture = (as_signed(image)[None] + 1).div(2).contiguous(memory_format=torch.channels_last)
        with torch.inference_mode():
            latents = encode(layers, picture)[0]
        save_file({"latents": latents.half().contiguous()}, file)
        print(f"{index + 1} of {len(photographs)}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
