"""Slow definitions, one point at a time, that the fast functions must agree with."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np
import torch

from lidar2pano.calibration import LensCalibration
from lidar2pano.geometry.projection import directions
from lidar2pano.views import View


def place_slowly(point: np.ndarray, view: View) -> tuple[int, int] | None:
    """Row and column of the pixel that a point (x, y, z) falls into, None where it is unusable or out of view."""
    if not np.isfinite(point).all() or not point.any():
        return None
    x, y, z = (point.astype(np.float32) - np.float32(view.origin)).astype(float).tolist()
    if x == y == z == 0:
        return None
    turned = (view.left - math.degrees(math.atan2(y, x))) % 360  # clockwise from the left edge
    column = math.floor(turned * view.columns / (view.left - view.right))
    flat = math.hypot(x, y)
    if view.kind == "sphere":
        height = math.degrees(math.atan2(z, flat))
    else:
        height = z / flat if flat else math.copysign(math.inf, z)
    depth = (view.up - height) * view.rows / (view.up - view.down)
    if not 0 <= depth < view.rows or not 0 <= column < view.columns:
        return None
    return math.floor(depth), column


def points_on_rays(range_m: torch.Tensor, view: View) -> torch.Tensor:
    """Points (H, W, 3) float32, sensor frame, metres, of ranges (H, W) from the view's origin; NaN where they are 0."""
    points = range_m[..., None] * directions(view) + torch.tensor(view.origin)
    return points.where(range_m[..., None] > 0, torch.nan)


def project_slowly(xyz: np.ndarray, view: View) -> dict[tuple[int, int], int]:
    """Which point (N, 3) owns which pixel: the nearest; of equals the first."""
    owner: dict[tuple[int, int], int] = {}
    nearest: dict[tuple[int, int], float] = {}
    for number, point in enumerate(xyz):
        pixel = place_slowly(point, view)
        if pixel is None:
            continue
        x, y, z = point - np.float32(view.origin)
        squared = float(x * x + y * y + z * z)
        if squared < nearest.get(pixel, math.inf):
            owner[pixel], nearest[pixel] = number, squared
    return owner


def nearest_slowly(cell: list[int], distance: list[float], cells: int) -> list[int]:
    """Which point owns each cell: the nearest; of equals the first; -1 where there is none."""
    owner = [-1] * cells
    for number, (at, away) in enumerate(zip(cell, distance, strict=True)):
        if at < cells and (owner[at] < 0 or away < distance[owner[at]]):
            owner[at] = number
    return owner


def vote_slowly(
    ranges: np.ndarray, ids: np.ndarray, pixel: tuple[int, int], range_m: float, *, own: bool, circular: bool
) -> int:
    """The class of one point by KNN clean-up with 5 neighbours, 5 x 5 search, sigma 1, cut-off 1 m.

    ranges (H, W), infinite where empty; pixel: the point's row and column; own: it is nearest to itself.
    """
    rows, columns = ranges.shape
    window = [math.exp(-(i * i + j * j) / 2) for i in range(-2, 3) for j in range(-2, 3)]
    candidates: list[tuple[float, int]] = []
    for number, weight in enumerate(window):
        row, column = pixel[0] + number // 5 - 2, pixel[1] + number % 5 - 2
        if circular:
            column %= columns
        if not (0 <= row < rows and 0 <= column < columns) or not math.isfinite(ranges[row, column]):
            continue
        factor = np.float32(1) - np.float32(weight / sum(window))
        distance = abs(np.float32(ranges[row, column]) - np.float32(range_m)) * factor
        candidates.append((0.0 if own and number == 12 else float(distance), int(ids[row, column])))
    votes = Counter(label for distance, label in sorted(candidates)[:5] if distance <= 1 and label != 0)
    return min(votes, key=lambda label: (-votes[label], label), default=0)


# --- losses and the confusion matrix --------------------------------------------------------------------------------


def lovasz_softmax_slowly(probabilities: torch.Tensor, target: torch.Tensor, ignore: int | None = None) -> torch.Tensor:
    """Berman et al. 2018, equations 8, 9 and 11, of (B, C, H, W) and (B, H, W), differentiated by autograd."""
    kept = torch.ones_like(target, dtype=torch.bool) if ignore is None else target != ignore
    losses = []
    for c in range(probabilities.shape[1]):
        own = (target == c)[kept].to(probabilities.dtype)
        if not own.any():
            continue
        error, order = (own - probabilities[:, c][kept]).abs().sort(descending=True)
        own = own[order]
        jaccard_loss = 1 - (own.sum() - own.cumsum(0)) / (own.sum() + (1 - own).cumsum(0))  # of the i + 1 worst
        rises = torch.cat([jaccard_loss[:1], jaccard_loss[1:] - jaccard_loss[:-1]])
        losses.append(torch.dot(error, rises))
    return torch.stack(losses).mean()


def confusion_slowly(
    predicted: torch.Tensor, target: torch.Tensor, classes: int, unscored: tuple[int, ...] = ()
) -> list[list[int]]:
    """Counts by [target][predicted], one pixel at a time."""
    counts = [[0] * classes for _ in range(classes)]
    for p, t in zip(predicted.flatten().tolist(), target.flatten().tolist(), strict=True):
        if 0 <= t < classes and t not in unscored:
            counts[t][p] += 1
    return counts


def pose_between(trajectory, stamp_s: float) -> np.ndarray:
    """(4, 4) pose at a stamp: the rotation from one recorded pose to the next goes on evenly about its own axis."""
    place = np.clip(stamp_s, trajectory.stamp_s[0], trajectory.stamp_s[-1])
    after = max(1, next(n for n, stamp in enumerate(trajectory.stamp_s) if stamp >= place))
    share = (place - trajectory.stamp_s[after - 1]) / (trajectory.stamp_s[after] - trajectory.stamp_s[after - 1])
    T = np.eye(4)
    T[:3, 3] = trajectory.translation[after - 1] * (1 - share) + trajectory.translation[after] * share
    before, goal = (rotation_of(trajectory.rotation[n]) for n in (after - 1, after))
    step = before.T @ goal
    angle = np.arccos(np.clip((np.trace(step) - 1) / 2, -1, 1))
    K = (step - step.T) / (2 * np.sin(angle))  # Rodrigues
    T[:3, :3] = before @ (np.eye(3) + np.sin(share * angle) * K + (1 - np.cos(share * angle)) * K @ K)
    return T


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """(3, 3) of x y z w: each axis turned by the product q v q*."""
    vector, w = quaternion[:3], quaternion[3]
    columns = []
    for axis in np.eye(3):
        t = 2 * np.cross(vector, axis)
        columns.append(axis + w * t + np.cross(vector, t))
    return np.stack(columns, 1)


def deskewed_slowly(xyz: np.ndarray, time_s: np.ndarray, stamp_s: float, motion) -> np.ndarray:
    """Each point through the pose of its own time into the world, and back through the pose of the stamp."""
    back = np.linalg.inv(motion.at(np.array([stamp_s]))[0])
    found = xyz.astype(np.float64)
    for number, (point, time) in enumerate(zip(xyz, time_s, strict=True)):
        if np.isfinite(time):
            found[number] = (back @ motion.at(np.array([stamp_s + time]))[0] @ [*point, 1])[:3]
    return found


# --- instances on panoramas -----------------------------------------------------------------------------------------


def grow_slowly(seeds: torch.Tensor, inside: torch.Tensor, steps: int) -> torch.Tensor:
    """Ids spread to the pixels `inside`, by the way to the nearest seed through them; of equals the greatest id."""
    rows, columns = seeds.shape
    grown = seeds.clone()
    front = {tuple(place): int(seeds[tuple(place)]) for place in seeds.nonzero().tolist()}
    for _ in range(steps):
        reached: dict[tuple[int, int], int] = {}
        for (row, column), number in front.items():
            for down, right in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
                place = (row + down, (column + right) % columns)
                if 0 <= place[0] < rows and inside[place] and not grown[place]:
                    reached[place] = max(reached.get(place, 0), number)
        for place, number in reached.items():
            grown[place] = number
        front = reached
    return grown


def camera_pixel_slowly(ray: Sequence[float] | np.ndarray, camera: LensCalibration) -> tuple[float, float]:
    """The pixel (u, v) of a direction, as OpenCV's documentation and KITTI-360's project.py write the models."""
    x, y, z = ray
    if camera.model == "fisheye":
        radius = math.hypot(x, y)
        theta = math.atan2(radius, z)
        k1, k2, k3, k4 = camera.distortion
        theta_d = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
        scale = theta_d / radius if radius else 1.0
        xd, yd = x * scale, y * scale
    else:
        coefficients, ahead = camera.distortion, z
        if camera.model == "mei":
            xi, *coefficients = camera.distortion
            ahead = z + xi * math.sqrt(x * x + y * y + z * z)
        k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
        a, b = x / ahead, y / ahead
        r2 = a * a + b * b
        radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        xd = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
        yd = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    u, v, _ = camera.K @ np.array([xd, yd, 1.0])
    return u, v


def look_up_slowly(image: np.ndarray, view: View, ray: tuple[float, float, float]) -> list[float]:
    """Colour (C,) of an image (H, W, C) of a circular cylinder in a direction, bilinear between pixel centres."""
    x, y, z = ray
    column = (180 - math.degrees(math.atan2(y, x))) / 360 * view.columns - 0.5
    row = (view.up - z / math.hypot(x, y)) / (view.up - view.down) * view.rows - 0.5
    row = min(max(row, 0), view.rows - 1)
    upper, left = math.floor(row), math.floor(column)
    lower = min(upper + 1, view.rows - 1)
    below, right = row - upper, column - left
    corners = (
        {
            (upper, left): (1 - below) * (1 - right),
            (upper, left + 1): (1 - below) * right,
            (lower, left): below * (1 - right),
            (lower, left + 1): below * right,
        }
        if lower > upper
        else {(upper, left): 1 - right, (upper, left + 1): right}
    )
    return [
        sum(share * float(image[i, j % view.columns, channel]) for (i, j), share in corners.items())
        for channel in range(image.shape[2])
    ]


def first_hits_slowly(surfels, rays) -> np.ndarray:
    """Range of each ray (B, F): of the nearest ellipse it meets, averaged with those right behind it.

    Right behind: no farther than their own reach. The ray meets an ellipse where it meets its plane; an offset's parts
    along the half axes are 1 at the border.
    """
    ranges = np.full((len(rays.elevation), rays.firings), np.inf)
    for beam in range(len(rays.elevation)):
        for firing in range(rays.firings):
            azimuth = math.radians(180 - (firing + 0.5) * 360 / rays.firings) + rays.azimuth[beam]
            level = math.cos(rays.elevation[beam])
            ray = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(rays.elevation[beam])])
            hits = []
            for number in range(len(surfels.centre)):
                centre, normal = surfels.centre[number], surfels.normal[number]
                if np.linalg.norm(centre) <= surfels.reach_m[number]:
                    continue
                range_m = centre @ normal / (ray @ normal)
                offset = ray * range_m - centre
                square = (offset @ surfels.major[number]) ** 2 + (offset @ surfels.minor[number]) ** 2
                if range_m > 0 and square <= 1:
                    hits.append((range_m, math.exp(-2 * square), surfels.reach_m[number]))
            if hits:
                nearest = min(range_m for range_m, _, _ in hits)
                front = [(range_m, weight) for range_m, weight, reach in hits if range_m <= nearest + reach]
                ranges[beam, firing] = sum(r * w for r, w in front) / sum(w for _, w in front)
    return ranges
