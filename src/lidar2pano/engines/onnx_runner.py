"""A scan becomes a panorama by the three graphs beside this file, with numpy and ONNX Runtime alone.

    python run.py SCAN.bin PANORAMA.ppm        (KITTI's .bin: float32 x, y, z, remission)

It computes what lidar2pano does, without its KNN clean-up of point labels.
"""

import json
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
SKY, ROAD, FAR_M, OWN_VEHICLE_M = 15, 7, 120.0, 1.0  # ids of common-15; metres
COARSE_M, FINE_M, AWAY_M = (0.25, 1.0, 4.0), (0.0625, 0.125, 0.5), 4096.0  # wavelengths of the painter's noise
VARIED = np.array(
    [0, 0.15, 0, 0, 0.15, 0.15, 0.15, 0, 0, 0.17, 0.15, 0, 0, 0.1, 0, 0]
)  # of classes: how their brightness varies
OBJECT_M, COARSER = 16.0, 4  # wavelength of that, and the step at which it is read


def main(scan, out):
    """Run the graphs one after the other."""
    points = np.fromfile(scan, dtype=np.float32).reshape(-1, 4)
    points = points[np.isfinite(points).all(1) & (np.linalg.norm(points[:, :3], axis=1) >= OWN_VEHICLE_M)]
    segmenter, translator, painter = (Graph(role) for role in ("segmenter", "translator", "painter"))
    image, row, column, owner = project(points, segmenter.card["views"]["input"])
    mean, deviation = (np.float32(value)[:, None, None] for value in segmenter.card["normalisation"].values())
    (logits,) = segmenter((image - mean) / deviation * (owner >= 0))
    labels = logits.argmax(0)[row.clip(0, len(logits[0]) - 1), column]  # of each point
    view = translator.card["views"]["panorama"]
    image, _, _, owner = project(points, view)
    condition = np.where(owner >= 0, labels[owner], 0) == np.arange(20)[:, None, None]
    logits, depth_m = translator(image, condition)
    segments = np.exp(logits - logits.max(0))
    segments /= segments.sum(0)
    inputs, fine_noise = painter_inputs(segments, depth_m, image, view, painter.card["settings"].get("sharp", 2.0))
    looks, own = painter.card["settings"]["looks"], painter.card["settings"].get("look")
    shares = np.eye(len(looks))[looks.index(own or looks[0])]  # a mean of looks: shares that sum to 1
    (colour,) = painter(inputs, fine_noise, shares, np.zeros(3))
    pixels = np.rint((colour + 1) * 127.5).clip(0, 255).astype(np.uint8).transpose(1, 2, 0)
    Path(out).write_bytes(b"P6 %d %d 255\n" % (pixels.shape[1], pixels.shape[0]) + pixels.tobytes())


class Graph:
    """A graph beside this file, its card, and a call with one scan's arrays (no batch) in the order of its inputs."""

    def __init__(self, role):
        import onnxruntime

        self.session = onnxruntime.InferenceSession(HERE / f"{role}.onnx")
        self.names = [each.name for each in self.session.get_inputs()]
        self.card = json.loads(self.session.get_modelmeta().custom_metadata_map["card"])

    def __call__(self, *arrays):
        """Arrays without a batch -> arrays without a batch."""
        batch = [np.ascontiguousarray(array, dtype=np.float32)[None] for array in arrays]
        return [output[0] for output in self.session.run(None, dict(zip(self.names, batch, strict=True)))]


def project(points, view):
    """Range image (5, H, W), row and column of each point, and the point that owns each pixel (-1: none)."""
    xyz = points[:, :3] - np.float32(view["origin"])
    x, y, z = xyz.T.astype(np.float64)
    rows, columns, flat = view["rows"], view["columns"], np.hypot(x, y)
    sphere = view["kind"] == "sphere"
    height = np.degrees(np.arctan2(z, flat)) if sphere else z / np.maximum(flat, 1e-9)
    row = np.floor((view["up"] - height) * rows / (view["up"] - view["down"])).clip(-1, rows).astype(np.int64)
    column = np.floor((0.5 - np.arctan2(y, x) / (2 * np.pi)) * columns).astype(np.int64) % columns
    range_m = np.linalg.norm(xyz, axis=1)
    order = np.argsort(range_m, kind="stable")[::-1]  # the nearest, and of equals the first, is written last
    order = order[(row[order] >= 0) & (row[order] < rows)]
    owner = np.full((rows, columns), -1)
    owner[row[order], column[order]] = order
    channels = np.column_stack([range_m, xyz, points[:, 3]])[owner].transpose(2, 0, 1)
    return channels * (owner >= 0), row, column, owner


def painter_inputs(segments, depth_m, image, view, exponent):
    """What the scene painter sees: `inputs` (30, H, W) and `fine_noise` (3, 2H, 2W); the README lists the channels."""
    rows, columns = depth_m.shape
    segments = segments**exponent / (segments**exponent).sum(0)
    best = segments.argmax(0)
    slope = (view["up"] - (np.arange(rows) + 0.5) / rows * (view["up"] - view["down"]))[:, None]
    radius_m = depth_m / np.sqrt(1 + slope**2)
    z_m = radius_m * slope
    sensor_z_m = z_m + view["origin"][2]
    near = ((best == ROAD) & (radius_m > 3) & (radius_m < 20))[:, ::4]
    found = np.sort(sensor_z_m[:, ::4][near])
    road_m = found[(len(found) - 1) // 2] if len(found) >= 50 else -1.73
    height = ((sensor_z_m - (road_m if -4 < road_m < -0.5 else -1.73)) / 4).clip(-1, 4)
    shape = np.stack([height, *normals(radius_m, z_m, 2 * np.pi / columns)]) * (best != SKY)
    code = np.log1p(depth_m.clip(max=FAR_M)) / np.log1p(FAR_M)
    row = np.repeat(np.linspace(1, -1, rows)[:, None], columns, 1)
    flat = [code, *spread_out(image[4], image[0] > 0), row]
    coarse = solid_noise(depth_m, best == SKY, view, COARSE_M)
    fine = solid_noise(*(each.repeat(2, 0).repeat(2, 1) for each in (depth_m, best == SKY)), view, FINE_M)
    brighter = np.einsum("chw,c->hw", segments, VARIED) * smooth_noise(radius_m, z_m, view, OBJECT_M).clip(-1, 1)
    return np.concatenate([segments, np.stack(flat), shape, coarse, np.stack(3 * [brighter])]), fine


def normals(radius_m, z_m, step):
    """Unit normals (radial, tangential, up) from central differences; columns are circular."""
    right, left = np.roll(radius_m, -1, 1), np.roll(radius_m, 1, 1)
    radial, tangential = (right - left) * np.cos(step), (right + left) * -np.sin(step)
    up = np.roll(z_m, -1, 1) - np.roll(z_m, 1, 1)
    down_r, down_z = (np.pad(each[2:] - each[:-2], ((1, 1), (0, 0)), "edge") for each in (radius_m, z_m))
    normal = np.stack([-down_z * tangential, down_z * radial - down_r * up, down_r * tangential])
    return normal / np.sqrt((normal**2).sum(0) + 1e-12)


def spread_out(remission, valid):
    """Mean remission of what is valid within 5 x 3 pixels, else within 11 x 7; and whether there is any."""
    mean, found = np.zeros(valid.shape), np.zeros(valid.shape, dtype=bool)
    for rows, columns in ((5, 3), (11, 7)):
        padding = ((rows // 2, rows // 2), (0, 0))
        beside = range(-(columns // 2), columns // 2 + 1)
        padded = (np.pad(each, padding) for each in (remission * valid, valid.astype(np.float64)))
        total, count = (
            sum(np.roll(each[i : i + len(valid)], j, 1) for i in range(rows) for j in beside) for each in padded
        )
        mean = np.where((count > 0) & ~found, total / np.maximum(count, 1), mean)
        found |= count > 0
    return mean, found


def solid_noise(depth_m, sky, view, wavelengths_m):
    """Noise at the points that pixels show, one layer per wavelength, faded out where a pixel could not show it."""
    rows, columns = depth_m.shape
    tile, voxel_m = np.load(HERE / "noise.npy"), min(wavelengths_m) / 4
    slope = (view["up"] - (np.arange(rows) + 0.5) / rows * (view["up"] - view["down"]))[:, None]
    azimuth = np.pi - (np.arange(columns) + 0.5) / columns * 2 * np.pi
    distance = depth_m.clip(0.1, 200)
    radius = np.where(sky, 4, distance) / np.sqrt(1 + slope**2) / voxel_m
    place = [radius * np.cos(azimuth), radius * np.sin(azimuth), radius * slope]
    start = np.rint(np.array(view["origin"]) / voxel_m)
    moved = (part + AWAY_M / voxel_m + np.where(sky, 0, move) for part, move in zip(place, start, strict=True))
    index = [part.astype(np.int64) for part in moved]
    focal = np.where(sky, 1e3, 1 / distance) * columns / (2 * np.pi)
    layers = []
    for wave in wavelengths_m:
        shift = round(np.log2(wave / 4 / voxel_m))
        noise = tile[tuple(part >> shift & 63 for part in index)]
        layers.append(noise * (focal * wave - 1).clip(0, 1))
    return np.stack(layers)


def smooth_noise(radius_m, z_m, view, wavelength_m):
    """Noise of one long wavelength: the tile between its voxels, trilinear, at every COARSER-th row and column."""
    middle = slice(COARSER // 2, None, COARSER)
    radius, z = radius_m[middle, middle], z_m[middle, middle]
    azimuth = (np.pi - (np.arange(radius_m.shape[1]) + 0.5) / radius_m.shape[1] * 2 * np.pi)[middle]
    sensor = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], -1) + view["origin"]
    place = sensor * 4 / wavelength_m
    low = np.floor(place).astype(np.int64)
    tile, noise = np.load(HERE / "noise.npy"), 0.0
    for corner in np.ndindex(2, 2, 2):
        share = np.where(corner, place - low, 1 - (place - low)).prod(-1)
        noise = noise + tile[tuple(np.moveaxis((low + corner) % 64, -1, 0))] * share
    return noise.repeat(COARSER, 0).repeat(COARSER, 1)


if __name__ == "__main__":
    main(*sys.argv[1:])
