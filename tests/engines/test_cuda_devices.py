"""What can be known about CUDA without a GPU: no computation mixes tensors of two devices.

The device "meta", whose tensors have no memory, stands for CUDA. What depends on values (the projection's owners, the
height of the road) cannot be followed in this way.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from engine_of_torch import SLIM
from lidar2pano.geometry.rasters import upsample_azimuth, upsample_classes
from lidar2pano.models import build
from lidar2pano.models.latent_painter import conditions_of
from lidar2pano.models.world_noise import world_noise
from lidar2pano.scene.record import Scene
from random_weights import TRANSLATOR_VIEW

ELSEWHERE = torch.device("meta")
ROWS, COLUMNS = TRANSLATOR_VIEW.rows, TRANSLATOR_VIEW.columns
COPIES = ("_to_copy", "copy_", "index.Tensor")  # may take tensors of two devices, on CUDA too


class OneDevice(TorchDispatchMode):
    """Refuses operations on tensors of several devices, as CUDA does; numbers (0-d tensors) of the CPU are allowed."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        tensors = [each for each in tree_leaves((args, kwargs)) if isinstance(each, torch.Tensor)]
        devices = {each.device.type for each in tensors if each.ndim or each.device == ELSEWHERE}
        if len(devices) > 1 and not any(name in str(func) for name in COPIES):
            raise RuntimeError(f"{func}: tensors of {' and '.join(sorted(devices))}")
        return func(*args, **(kwargs or {}))


@pytest.fixture(autouse=True)
def _one_device():
    with torch.no_grad(), OneDevice():
        yield


def there(*shapes: tuple[int, ...]) -> list[torch.Tensor]:
    return [torch.empty(shape, device=ELSEWHERE) for shape in shapes]


def test_a_mixture_of_devices_is_found():
    (x,) = there((2, 3))
    with pytest.raises(RuntimeError, match="tensors of cpu and meta"):
        _ = x + torch.empty(2, 3)
    assert (x + torch.tensor(1.0)).device == ELSEWHERE


@pytest.mark.parametrize(
    ("model", "shapes", "outputs"),
    [
        ("salsanext", [(5, 32, 64)], [(20, 32, 64)]),
        ("titan-pano", [(5, 32, 64), (20, 32, 64)], [(16, 32, 64), (32, 64)]),
        (
            "latent-painter",
            [(26, 32, 64), (2,), (4, 8, 16), (), (), (), (5, 8, 16), (9,)],
            [(4, 8, 16), (4, 8, 16)],
        ),
    ],
)
def test_networks_stay_on_their_device(model, shapes, outputs):
    network = build(model, **SLIM[model]).eval().to(ELSEWHERE)
    found = network(*there(*((1, *shape) for shape in shapes)))
    found = found if isinstance(found, tuple) else (found,)
    assert [(one.device, tuple(one.shape)) for one in found] == [(ELSEWHERE, (1, *shape)) for shape in outputs]


def test_what_a_painter_reads_stays_on_its_device(monkeypatch):
    monkeypatch.setattr("torch.fx.experimental._config.meta_nonzero_assume_all_nonzero", True)
    segments, depth_m, channels, viewpoint_m = there(
        (1, 16, ROWS, COLUMNS), (1, ROWS, COLUMNS), (1, 5, ROWS, COLUMNS), (1,)
    )
    scene = Scene(
        view=TRANSLATOR_VIEW, channels=channels, probabilities=segments, depth_m=depth_m, viewpoint_m=viewpoint_m
    )
    posed = replace(scene, T_world_sensor=np.eye(4))
    particles, noise = world_noise(None, posed, 4, 4)
    parts = [
        conditions_of(scene),
        noise,
        world_noise(particles, posed, 4, 4)[1],
        upsample_classes(segments, 2),
        upsample_azimuth(depth_m[None], 2),
    ]
    assert {part.device for part in parts} == {ELSEWHERE}
