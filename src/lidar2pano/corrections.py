"""What the points of a scan say against a translator's prediction: where surfaces are, and of which class.

A translator is right on average. What was measured is known: on which surface a pixel lies, how rough it is, how high
above the road.
"""

from __future__ import annotations

from torch import Tensor

from lidar2pano.geometry.flat_ground import no_flat_fences
from lidar2pano.geometry.kerbs import weigh_by_height
from lidar2pano.geometry.measured_depth import measured_depth
from lidar2pano.geometry.odds import likeliest
from lidar2pano.geometry.outlines import evened
from lidar2pano.geometry.roughness import Evidence, weigh_by_roughness
from lidar2pano.geometry.surface import cylinder_points, viewpoint_height
from lidar2pano.geometry.whole_walls import no_patches, whole_walls
from lidar2pano.labels import COMMON15
from lidar2pano.views import View

NAMES = ("road", "sidewalk", "terrain", "building", "fence", "vegetation")
ROAD, SIDEWALK, TERRAIN, BUILDING, FENCE, VEGETATION = map(COMMON15.id_of, NAMES)
GROUND, BANK = (ROAD, SIDEWALK, TERRAIN), (TERRAIN, VEGETATION)
FOUR_WHEELED = tuple(map(COMMON15.id_of, ("car", "truck", "other-vehicle")))
PATCHES = ((VEGETATION, BUILDING), (FENCE, BUILDING), (FENCE, VEGETATION))  # none of one within the other
ROUGH = (
    Evidence(VEGETATION, [BUILDING], limit_m=0.04, growth=0.0, power=1.0),
    Evidence(TERRAIN, [ROAD, SIDEWALK], limit_m=0.017, growth=0.8, power=4.0),
)


def corrected(logits: Tensor, depth_m: Tensor, channels: Tensor, view: View) -> tuple[Tensor, Tensor]:
    """A translator's logits (B, C, H, W) and depths (B, H, W), float32, by the range image (B, 5, H, W) on its raster.

    Borders on the ground are evened; foliage and walls, grass and asphalt are weighed by roughness, sidewalk and road
    by height; depths keep to what was measured; a fence that carries a house, or a vehicle that stands on one, is its
    wall, a fence that lies flat is ground, and one that slopes a bank; foliage and fences within a wall, and fences
    within foliage are no longer there.
    """
    logits = evened(logits, GROUND)
    weigh_by_roughness(logits, channels, depth_m, ROUGH)
    best = likeliest(logits)
    depth_m = measured_depth(depth_m, channels, best, view, ROAD, VEGETATION)
    weigh_by_height(logits, best, depth_m, view, ROAD, SIDEWALK)
    radius_m, z_m = cylinder_points(depth_m, view)
    height_m = z_m + viewpoint_height(radius_m, z_m, best == ROAD, view)[:, None, None]
    whole_walls(logits, best, radius_m, height_m, BUILDING, FENCE, FOUR_WHEELED)
    no_patches(logits, best, radius_m, PATCHES)
    no_flat_fences(logits, best, radius_m, height_m, GROUND, BANK, FENCE)  # of what is no wall
    return logits, depth_m
