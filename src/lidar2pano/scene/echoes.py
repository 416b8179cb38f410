"""Images of a sensor's echoes: range, remission and near-infrared light, without holes between the beams."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lidar2pano.geometry.projection import project
from lidar2pano.scan import Scan
from lidar2pano.scene.depth import denser
from lidar2pano.views import View

# Factors of coarser rasters, which fill holes one after the other: beams up to 4 FAR_PX = 48 pixels apart meet,
# on the panorama's raster 3.7 degrees; those of 16 beams lie 2 degrees apart.
COARSER = (1, 2, 4)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EchoImage:
    """Echoes of a scan on a raster (h, w); zero where there are none.

    range_m        float32 metres from the view's origin.
    remission      float32 in [0, 1].
    near_infrared  float32 as stored; None if the scan has none.
    """

    range_m: Tensor
    remission: Tensor
    near_infrared: Tensor | None


def echo_image(scan: Scan, view: View) -> EchoImage:
    """Return the echoes of a scan on a raster: those in a pixel, else of the surface between its neighbours' beams.

    Points nearer to the sensor than OWN_VEHICLE_M do not count. Near-infrared light between beams is the nearer one's.
    """
    scan = scan.beyond()
    image = torch.zeros(3, view.rows, view.columns)
    light = None if scan.near_infrared is None else torch.from_numpy(scan.near_infrared)
    row, column = torch.arange(view.rows)[:, None], torch.arange(view.columns)
    for factor in COARSER:
        coarse = view.scaled(1 / factor)
        _, dense, source = denser(scan, project(scan, coarse))
        layers = torch.cat([dense.channels[[0, 4]], torch.zeros(1, coarse.rows, coarse.columns)])
        if light is not None:
            layers[2, dense.valid] = light[source[dense.index[dense.valid]]]
        enlarged = layers[:, row * coarse.rows // view.rows, column * coarse.columns // view.columns]
        image = torch.where(image[0] > 0, image, enlarged)
    range_m, remission, near_infrared = image
    return EchoImage(
        range_m=range_m, remission=remission, near_infrared=None if light is None else near_infrared.contiguous()
    )
