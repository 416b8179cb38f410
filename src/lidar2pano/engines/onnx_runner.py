"""A scan becomes a panorama by the three graphs beside this file, with numpy and ONNX Runtime alone.

    python run.py SCAN.bin PANORAMA.ppm        (KITTI's .bin: float32 x, y, z, remission)

It computes what lidar2pano does, without its KNN clean-up of point labels and without the whole cars that it lays over
what the translator found of them (`lidar2pano.geometry.whole_cars`).
"""

import json
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
SKY, PERSON, ROAD, BUILDING, FENCE, VEGETATION, TERRAIN, GROUND = (
    15,
    6,
    7,
    9,
    10,
    11,
    12,
    [7, 8, 12],
)  # ids of common-15
SIGN, LIKELY = 14, 0.05  # probability of people and of signs from which on they are given colours
FOUR_WHEELED = [1, 4, 5]  # car, truck, other-vehicle
ROUGH = ((VEGETATION, [BUILDING], 0.04, 0.0, 1.0), (GROUND[2], GROUND[:2], 0.017, 0.8, 4.0))
SMOOTH = [1, 2, 3, 4, 5, 6, 13, 14]  # vehicles, people, poles and signs: no noise
FAR_M, OWN_VEHICLE_M = 120.0, 1.0  # metres
CLASSES = (  # noqa: SIM905 of common-15, as one line each they would fill the page
    "unlabeled car bicycle motorcycle truck other-vehicle person road sidewalk building fence vegetation terrain pole"
    " traffic-sign sky"
).split()
COARSE_M, FINE_M, AWAY_M = (0.25, 1.0, 4.0), (0.0625, 0.125, 0.5), 4096.0  # wavelengths of the painter's noise
VARIED = np.zeros(16)  # how the brightness of car, truck, other-vehicle, fence and pole varies
VARIED[[1, 4, 5, 10, 13]] = 0.15, 0.15, 0.15, 0.15, 0.1
OBJECT_M, COARSER = 16.0, 4  # wavelength of that, and the step at which it is read
TOPS = (
    (-0.25, -0.25, -0.2),
    (0.1, -0.15, -0.15),
    (0.5, 0.5, 0.48),
    (0.05, 0.1, 0.3),
    (0.2, 0.2, 0.2),
    (-0.1, 0, -0.12),
)
TROUSERS = ((-0.15, -0.08, 0.1), (-0.3, -0.3, -0.3), (-0.12, -0.06, 0.12), (0.08, 0.03, -0.06), (-0.3, -0.3, -0.28))
TROUSERS += ((-0.15, -0.08, 0.08),)  # what people wear
SIGNS = ((0.1, 0.1, 0.05), (0.6, 0.45, -0.2), (0.6, 0.6, 0.55), (-0.25, -0.05, 0.4), (0.1, 0.1, 0.05))
SKIN, HAIR = (0.4, 0.22, 0.12), (-0.3, -0.32, -0.34)
LIT, LIT_M, SUNNY_SIDE, SUNLIT = 0.22, 15.0, 0.15, 0.2  # how much brighter than the mean trees are
LEAVES = (1.0, 1.03, 0.78)  # of red, green and blue in that
HOUSES_VARIED, HOUSE_M = 0.5, 11.0  # how much houses differ in brightness, their width
REACH = 40  # columns around that say how a wall runs


def main(scan, out):
    """Run the graphs one after the other."""
    points = np.fromfile(scan, dtype=np.float32).reshape(-1, 4)
    points = points[np.isfinite(points).all(1) & (np.linalg.norm(points[:, :3], axis=1) >= OWN_VEHICLE_M)]
    segmenter, translator, painter = (Graph(role) for role in ("segmenter", "translator", "painter"))
    points = with_points_between(points, segmenter.card["views"]["input"])
    image, row, column, _ = project(points, segmenter.card["views"]["input"])
    (logits,) = segmenter(normalised(image, segmenter.card["normalisation"]))
    labels = logits.argmax(0)[row.clip(0, len(logits[0]) - 1), column]  # of each point
    view = translator.card["views"]["panorama"]
    image, _, _, owner = project(points, view)
    condition = np.where(owner >= 0, labels[owner], 0) == np.arange(20)[:, None, None]
    logits, depth_m = translator(image, condition)
    segments = weigh_by_roughness(evened(softmax(logits)), image, depth_m)
    best = segments.argmax(0)
    depth_m = measured_depth(depth_m, image, best, view)
    segments = weigh_by_height(segments, best, depth_m, view)
    surface = radius_and_height(best, depth_m, view)
    segments = no_patches(whole_walls(segments, best, *surface), best, surface[0])
    segments = no_flat_fences(segments, segments.argmax(0), *surface)
    settings = painter.card["settings"]
    unread = [CLASSES.index(name) for name in settings.get("unread", ("building", "vegetation", "fence"))]
    inputs, fine_noise = painter_inputs(segments, depth_m, image, view, settings, unread)
    looks, own = settings["looks"], settings.get("look")
    shares = np.eye(len(looks))[looks.index(own or looks[0])]  # a mean of looks: shares that sum to 1
    (colour,) = painter(framed(inputs, 16), framed(fine_noise, 4), shares, np.zeros(3))
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


def with_points_between(points, view):
    """The points, followed by those that are put between beams or columns of a sensor that has few of them."""
    image, _, _, owner = project(points, view)
    flat, rows, columns = np.hypot(image[1], image[2]), view["rows"], view["columns"]
    there = (owner >= 0) & (flat > 0)
    raster = np.stack([there / np.where(there, flat, 1), image[4], there]).astype(np.float32)
    wide = np.concatenate([raster[..., -12:], raster, raster[..., :12]], 2)
    raster = interpolated(interpolated(wide.transpose(0, 2, 1)).transpose(0, 2, 1)[..., 12:-12])
    row, column = np.nonzero((raster[0] > 0) & ~there)
    inverse, remission, _ = raster[:, row, column]
    elevation = np.radians(view["up"] - (row + 0.5) * (view["up"] - view["down"]) / rows)
    azimuth = np.pi - (column + 0.5) * 2 * np.pi / columns
    xyz = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], 1) / inverse[:, None] + view["origin"]
    return np.concatenate([points, np.column_stack([xyz, remission])]).astype(np.float32)


def interpolated(raster):
    """Inverse distances, remission and 1 where known (3, H, W), with what lies between neighbours above each other."""
    inverse, remission, there = raster
    rows, row = len(there), np.arange(len(there))[:, None]
    above = np.maximum.accumulate(np.where(there > 0, row, -1), 0)
    below = np.minimum.accumulate(np.where(there > 0, row, rows)[::-1], 0)[::-1]
    apart = (row[1:] - above[:-1])[(there[1:] > 0) & (above[:-1] >= 0)]
    mean = np.mean(apart[apart <= 12]) if (apart <= 12).any() else 1.0
    new = (there == 0) & (above >= 0) & (below < rows) & (below - above <= round(1.5 * mean)) & (mean >= 1.5)
    above, below = above.clip(min=0), below.clip(max=rows - 1)
    share = ((row - above) / (below - above).clip(min=1)).astype(np.float32)
    upper, lower = (np.take_along_axis(inverse, at, 0) for at in (above, below))
    one_surface = np.maximum(upper, lower) < 1.4 * np.minimum(upper, lower)
    share = np.where(one_surface, share, share > 0.5)
    first, second = (np.take_along_axis(remission, at, 0) for at in (above, below))
    between = np.stack([upper + share * (lower - upper), first + share * (second - first), np.ones_like(share)])
    return np.where(new, between, raster)


def normalised(image, normalisation):
    """What the segmenter reads of a range image: its channels, zero where empty, and by its card the roughness."""
    mean, deviation = (np.array(normalisation[part])[:, None, None] for part in ("mean", "deviation"))
    total, count = deviations(image)
    channels = np.concatenate([image, (total / count.clip(min=1))[None]])[: len(mean)]
    known = np.concatenate([np.repeat(image[:1] > 0, 5, 0), count[None] > 0])[: len(mean)]
    return (channels - mean) / deviation * known


def softmax(logits):
    """Probabilities of logits (classes, H, W)."""
    segments = np.exp(logits - logits.max(0))
    return segments / segments.sum(0)


def evened(segments):
    """Probabilities in which road, sidewalk and terrain are shared as in a Gaussian around each pixel."""
    ground = segments[GROUND]
    around = blurred(ground, 1.6, 1.5).clip(min=1e-12)
    segments = segments.copy()
    segments[GROUND] = around / around.sum(0) * ground.sum(0)
    return segments


def blurred(x, degrees, rows):
    """Images (..., H, W) under a Gaussian with these deviations."""
    across, down = gaussian(degrees / 360 * x.shape[-1]), gaussian(rows)
    around = sum(weight * np.roll(x, i - len(across) // 2, -1) for i, weight in enumerate(across))
    padded = np.pad(around, ((0, 0),) * (x.ndim - 2) + ((len(down) // 2,) * 2, (0, 0)), "edge")
    return sum(weight * padded[..., i : i + x.shape[-2], :] for i, weight in enumerate(down))


def gaussian(deviation):
    """The weights of a Gaussian out to three deviations."""
    place = np.arange(-np.ceil(3 * deviation), np.ceil(3 * deviation) + 1)
    weight = np.exp(-(place**2) / (2 * deviation**2))
    return weight / weight.sum()


def against_the_sky(segments, probabilities, depth_m, view):
    """Segments with a sharp outline against the sky, that of trees with leaves."""
    sky, focal = probabilities[SKY], view["columns"] / (2 * np.pi)
    nearest = np.min([np.roll(depth_m, shift, 1) for shift in range(-8, 9)], 0)
    padded = np.pad(nearest, ((8, 8), (0, 0)), constant_values=np.inf)
    nearest = blurred(np.min([padded[row : row + len(sky)] for row in range(17)], 0), 2.0, 8.0)
    noise = solid_noise(nearest, np.zeros(sky.shape, dtype=bool), view, (0.5, 2.0)).clip(-2, 2)
    trees = probabilities[VEGETATION] / (1 - sky).clip(min=1e-6)
    inside = sky + trees * (blurred(sky, 0.5, 2.0) - sky) - 0.5
    leafy = ((0.3 - np.abs(inside)) / 0.15).clip(0, 1)
    leaves_px = (0.12 * noise[0] + 0.3 * noise[1]) * focal / nearest * trees * leafy
    padded = np.pad(inside, ((3, 3), (0, 0)), "edge")
    slope = np.hypot(padded[6:] - padded[:-6], np.roll(inside, -3, 1) - np.roll(inside, 3, 1)) / 6
    pixels = inside / slope.clip(min=0.002) - leaves_px
    open_sky = 1 / (1 + np.exp(-(pixels / 0.4).clip(-80, 80)))
    outlined = segments * (1 - open_sky) / (1 - segments[SKY]).clip(min=1e-6)
    outlined[SKY] = open_sky
    return outlined / outlined.sum(0)


def painter_inputs(segments, depth_m, image, view, settings, unread):
    """What the scene painter sees: `inputs` (31, H, W) and `fine_noise` (3, 2H, 2W); the README lists the channels."""
    rows, columns = depth_m.shape
    exponent = settings.get("sharp", 2.0)
    segments = against_the_sky(segments**exponent / (segments**exponent).sum(0), segments, depth_m, view)
    best = segments.argmax(0)
    slope = slopes(view)
    radius_m = depth_m / np.sqrt(1 + slope**2)
    z_m = radius_m * slope
    above_m = height_above(best == ROAD, radius_m, z_m, view)
    height = ((z_m + above_m) / 4).clip(-1, 4)
    tilted = normals(radius_m, z_m, 2 * np.pi / columns) * (1 - segments[PERSON])
    shape = np.stack([height, *tilted]) * (best != SKY)
    code = np.log1p(depth_m.clip(max=FAR_M)) / np.log1p(FAR_M)
    row = np.repeat(np.linspace(1, -1, rows).clip(-0.5)[:, None], columns, 1)
    read = 1 - segments[unread].sum(0)
    remission, valid = spread_out(*evened_beams(image[4], image[0] > 0, segments[ROAD]))
    remission = quiet_road(remission, valid, segments[ROAD])
    flat = [code, remission * read, valid * read, row]
    rough = 1 - segments[SMOOTH].sum(0)
    coarse = solid_noise(depth_m, best == SKY, view, COARSE_M) * rough
    rough = rough - 0.5 * segments[BUILDING]
    depth_m, sky, rough = (each.repeat(2, 0).repeat(2, 1) for each in (depth_m, best == SKY, rough))
    fine = solid_noise(depth_m, sky, view, FINE_M) * rough
    noise = smooth_noise(radius_m, z_m, view, OBJECT_M).clip(-1, 1)
    people, signs = (np.where(segments[each] > LIKELY, segments[each], 0) for each in (PERSON, SIGN))
    dressed = clothing(z_m + above_m, noise) * people + blended(SIGNS, noise) * signs
    brighter = np.einsum("chw,c->hw", segments, VARIED) * noise
    left = np.sin((np.arange(columns) + 0.5) / columns * 2 * np.pi)
    sun = settings.get("sun", False) * (LIT * (2 - radius_m / LIT_M).clip(0, 1) + SUNNY_SIDE * left)
    sun = segments[VEGETATION] * (sun + SUNLIT * noise.clip(0))
    openings, house = facades(segments[BUILDING], radius_m, slope, above_m, view)
    walls = house[:, None] - openings * house[:, None].clip(0)
    tones = brighter + np.reshape(LEAVES, (3, 1, 1)) * sun + dressed + segments[BUILDING] * HOUSES_VARIED * walls
    return np.concatenate([segments, np.stack(flat), shape, coarse, tones, openings[None]]), fine


def framed(channels, rows):
    """Images (C, H, W) with the last row again so many times below, and two columns of the other end at each side."""
    return np.pad(np.pad(channels, ((0, 0), (0, rows), (0, 0)), "edge"), ((0, 0), (0, 0), (2, 2)), "wrap")


def clothing(height_m, noise):
    """How much brighter than the mean person people are (3, H, W): trousers, tops, faces, hair."""
    tops, trousers = (blended(garment, noise) for garment in (TOPS, TROUSERS))
    head = np.where(height_m < 1.66, np.reshape(SKIN, (3, 1, 1)), np.reshape(HAIR, (3, 1, 1)))
    return np.where(height_m < 0.85, trousers, np.where(height_m < 1.45, tops, head))


def blended(colours, noise):
    """Of colours from -1 to 1 at even distances those of noise (H, W): (3, H, W)."""
    at = (noise + 1) / 2 * (len(colours) - 1)
    return np.stack([np.interp(at, range(len(colours)), each) for each in np.transpose(colours)])


def slopes(view, rows=None):
    """Tangents (H, 1) of the elevation of a view's rows, or of so many rows in their place."""
    rows = rows or view["rows"]
    return (view["up"] - (np.arange(rows) + 0.5) / rows * (view["up"] - view["down"]))[:, None]


def radius_and_height(best, depth_m, view):
    """How far away each pixel is horizontally, and how high above the road: (H, W) metres each."""
    slope = slopes(view)
    radius_m = depth_m / np.sqrt(1 + slope**2)
    return radius_m, radius_m * slope + height_above(best == ROAD, radius_m, radius_m * slope, view)


def no_flat_fences(segments, best, radius_m, height_m):
    """Segments in which what is level and about as high as the road is no fence, but ground, and a slope is a bank."""
    row, fence, columns = np.arange(len(best)), best == FENCE, best.shape[1]
    level = fence & (radius_m < 25) & (np.abs(height_m) < 0.5)
    sloping = fence & (radius_m < 12) & (np.abs(height_m) < 3)
    for upper, lower in (((row - 3).clip(0), row), (row, (row + 3).clip(max=row[-1]))):
        up, away = (np.abs(part[upper] - part[lower]) for part in (height_m, radius_m))
        level, sloping = level & (up <= 0.5 * away), sloping & (up <= 1.5 * away)
    begins = fence & ~np.pad(fence, ((1, 0), (0, 0)))[:-1]
    number = begins.T.cumsum().reshape(columns, -1).T  # of what adjoins in a column
    votes, counts = (np.bincount(number[fence], part[fence], number.max() + 1) for part in (level | sloping, fence))
    share = np.where(fence, (votes / counts.clip(1))[number], 0)
    share, count = (sum(np.roll(part.astype(float), shift, 1) for shift in range(-12, 13)) for part in (share, fence))
    bank, segments = fence & (share > count / 2), segments.copy()
    for others, there in ((GROUND, bank & level), ([TERRAIN, VEGETATION], bank & ~level)):
        moved, shares = np.where(there, segments[FENCE], 0), segments[others]
        segments[others] += moved * shares / shares.sum(0).clip(min=1e-30)
        segments[FENCE] -= moved
    return segments


def whole_walls(segments, best, radius_m, height_m):
    """Segments in which no fence carries a building and no vehicle stands on one or is too tall: they are building."""
    same = np.abs(np.log(radius_m[1:] / radius_m[:-1])) < 0.1
    house, fence, vehicle = best == BUILDING, best == FENCE, np.isin(best, FOUR_WHEELED)
    solid = house | fence | vehicle
    stands = begun_below(house, solid, same) | begun(solid & (height_m > 4.2), solid, same)
    house = house | (vehicle & stands)
    carries = begun(house & (height_m > 2), house | fence, same)
    segments = segments.copy()
    for each, where in [(FENCE, carries), *((each, stands) for each in FOUR_WHEELED)]:
        moved = np.where((best == each) & where, segments[each], 0)
        segments[BUILDING] += moved
        segments[each] -= moved
    return segments


def no_patches(segments, best, radius_m):
    """Segments without foliage or fences that have wall above and below in one surface, nor fences within foliage."""
    same, segments = np.abs(np.log(radius_m[1:] / radius_m[:-1])) < 0.1, segments.copy()
    for patch, around in ((VEGETATION, BUILDING), (FENCE, BUILDING), (FENCE, VEGETATION)):
        inside, outside = best == patch, best == around
        between = begun(outside, inside | outside, same) & begun_below(outside, inside | outside, same)
        moved = np.where(inside & between, segments[patch], 0)
        segments[around] += moved
        segments[patch] -= moved
    return segments


def begun(marked, one, same):
    """Whether a pixel, or one above it in a surface of pixels of `one`, is marked."""
    row = np.arange(1, len(one) + 1)[:, None]
    goes_on = np.zeros(one.shape, dtype=bool)
    goes_on[1:] = one[1:] & one[:-1] & same
    begin, last = (np.maximum.accumulate(np.where(each, row, 0), 0) for each in (~goes_on, marked))
    return last >= begin


def begun_below(marked, one, same):
    """Likewise, whether a pixel, or one below it, is marked."""
    return begun(marked[::-1], one[::-1], same[::-1])[::-1]


def weigh_by_roughness(segments, image, depth_m):
    """Segments in which the odds of foliage and walls, grass and asphalt have changed by how rough surfaces are."""
    found, far = roughness(image), np.log(depth_m.clip(2, 60) / 10)
    for rough, even, limit_m, growth, power in ROUGH:
        odds = np.nan_to_num(power * (found - np.log(limit_m) - growth * far), nan=0).clip(-3, 3)
        segments = weighed(segments, rough, even, odds)
    return segments


def weighed(segments, one, others, odds):
    """Segments in which the odds of one class against others are multiplied by exp(odds)."""
    before, segments = segments[others].sum(0), segments.copy()
    both, share = segments[one] + before, segments[one] * np.exp(odds)
    segments[one] = both * share / (share + before).clip(min=1e-30)
    segments[others] *= (both - segments[one]) / before.clip(min=1e-30)
    return segments


def weigh_by_height(segments, best, depth_m, view):
    """Segments in which what lies a kerb above the road's plane is rather sidewalk."""
    slope = slopes(view)
    azimuth = np.pi - (np.arange(view["columns"]) + 0.5) / view["columns"] * 2 * np.pi
    radius_m = depth_m / np.sqrt(1 + slope**2)
    place = np.stack([radius_m * np.cos(azimuth), radius_m * np.sin(azimuth), np.ones(radius_m.shape)])
    road = ((best == ROAD) & (radius_m > 3) & (radius_m < 25))[:, ::4]
    system, z = place[:, :, ::4][:, road], (radius_m * slope)[:, ::4][road]
    if len(z) < 50:
        return segments
    kept, plane = np.ones(len(z)), np.zeros(3)
    for _ in range(4):
        plane = np.linalg.solve((system * kept) @ system.T + 1e-6 * np.eye(3), (system * kept) @ z)
        kept = np.abs(plane @ system - z) < 0.12
    height_m = radius_m * slope - np.tensordot(plane, place, 1)
    return weighed(segments, GROUND[1], [ROAD], ((height_m - 0.04) * 40).clip(-1, 2) * (radius_m < 25))


def roughness(image):
    """Mean logarithm (H, W) of how far points are from the line between two beside them, NaN in columns without any."""
    sums = deviations(image)
    rows, columns = sums.shape[1] // 2, sums.shape[2] // 4
    sums = sums.reshape(2, rows, 2, columns, 4).sum((2, 4))
    sums = sum(np.roll(sums, shift, 2) for shift in range(-2, 3))
    padded = np.pad(sums, ((0, 0), (2, 2), (0, 0)))
    total, count = sum(padded[:, shift : shift + rows] for shift in range(5))
    mean, row = np.where(count > 3, total / count.clip(min=1), np.nan), np.arange(rows)[:, None]
    below = np.minimum.accumulate(np.where(np.isnan(mean), rows, row)[::-1], 0)[::-1]
    higher = np.maximum.accumulate(np.where(np.isnan(mean), -1, row), 0)
    mean = np.take_along_axis(mean, np.where(below < rows, below, higher.clip(min=0)), 0)
    return mean.repeat(2, 0).repeat(4, 1)


def deviations(image):
    """Sums of that logarithm for each point, and how many comparisons they are of: (2, H, W)."""
    flat = np.hypot(image[1], image[2])
    inverse = np.where(flat > 0, 1 / np.where(flat > 0, flat, 1), 0)
    sums = np.zeros((2, *flat.shape))
    for away in (1, 2, 3):
        left, right = np.roll(inverse, away, 1), np.roll(inverse, -away, 1)
        known = (left > 0) & (right > 0) & (inverse > 0)
        off = np.abs((left + right) / 2 - inverse) * flat**2
        sums += np.stack([np.log((off + 0.001).clip(max=1)), np.ones(flat.shape)]) * known
    return sums


def height_above(road, radius_m, z_m, view):
    """How high the viewpoint is above the road, metres."""
    near = (road & (radius_m > 3) & (radius_m < 20))[:, ::4]
    found = np.sort((z_m + view["origin"][2])[:, ::4][near])
    road_m = found[(len(found) - 1) // 2] if len(found) >= 50 else -1.73
    return view["origin"][2] - (road_m if -4 < road_m < -0.5 else -1.73)


def measured_depth(depth_m, image, best, view):
    """Depths that keep to what was measured: the translator's say which surface of its column a pixel shows."""
    slope = slopes(view)
    longer = np.sqrt(1 + slope**2)
    radius_m = depth_m / longer
    plane = -slope / max(height_above(best == ROAD, radius_m, radius_m * slope, view), 0.5)
    flat, guess = np.hypot(image[1], image[2]), 1 / radius_m.clip(min=0.5)
    inverse, plane = np.where(flat > 0.5, 1 / flat.clip(min=0.5), 0), plane.clip(min=1e-3)
    found = between(inverse, guess, plane)
    return longer / mean_of_planes(np.where(found > 0, found, above(inverse, guess, best)))


def between(inverse, guess, plane):
    """Inverse distances between and below a column's points, zero above them."""
    rows, row = len(inverse), np.arange(len(inverse))[:, None]
    first = np.maximum.accumulate(np.where(inverse > 0, row, -1), 0)
    last = np.minimum.accumulate(np.where(inverse > 0, row, rows)[::-1], 0)[::-1]
    pairs = []
    for at in (first.clip(min=0), last.clip(max=rows - 1)):
        met = np.take_along_axis(inverse, at, 0)
        lift = met / plane[at, 0]
        pairs.append((met, np.where((lift > 1 / 1.2) & (lift < 1.2), plane * lift, met)))  # level, or upright
    (upper, upper_along), (lower, along) = pairs
    share = (row - first) / (last - first).clip(min=1)
    other = np.where((guess**2 > upper * along) == (upper > along), upper, along)
    same = np.maximum(upper, lower) < 1.25 * np.minimum(upper, lower)
    inner = np.where(same, upper + (lower - upper) * share, other)
    return np.where(first < 0, 0, np.where(last < rows, inner, np.maximum(upper_along, plane)))


def above(inverse, guess, best):
    """Inverse distances of what stands above a column's topmost point: its own, in pixels of its class."""
    near = inverse
    for away in (1, 2):
        near = np.where(near > 0, near, np.maximum(np.roll(inverse, away, 1), np.roll(inverse, -away, 1)))
    top = (near > 0).argmax(0)[None]
    known, topmost, own = (near > 0).any(0)[None], *(np.take_along_axis(each, top, 0) for each in (near, best))
    crown = known & (own == VEGETATION)
    total, count = (sum(np.roll(each, shift, 1) for shift in range(-12, 13)) for each in (topmost * crown, 1 * crown))
    topmost = np.where(own == VEGETATION, (total / count.clip(min=1)) ** 0.9 * guess**0.1, topmost)
    return np.where((best == own) & known, topmost, guess)


def mean_of_planes(inverse):
    """Means over opposite pixels, where what lies between them is on one plane with them: rows, then columns."""
    rows = np.arange(len(inverse))[:, None]
    for axis in (0, 1):
        total, count = inverse.copy(), np.ones(inverse.shape)
        for away in (1, 2, 4):
            inside = (rows >= away) & (rows < len(rows) - away) if axis == 0 else rows >= 0
            mean = (np.roll(inverse, away, axis) + np.roll(inverse, -away, axis)) / 2
            even = inside & (np.abs(mean - inverse) < 0.03 * inverse)
            total, count = total + even * mean, count + even
        inverse = total / count
    return inverse


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


def evened_beams(remission, valid, road):
    """Remission, so that the road's is the same in all rows, and where it is used: not of beams that are dim."""
    weight, reach = valid * road, round(remission.shape[1] / 24)
    mean = (remission * weight).sum() / max(weight.sum(), 1e-6)
    of_rows, nearby = (row_means(remission, weight, mean, *near) for near in ((reach, 16), (reach // 4, 4)))
    factor = np.where(of_rows > 0, mean / of_rows.clip(min=1e-6), 1).clip(1 / 3, 3)
    return remission * factor, valid & ~((np.minimum(of_rows, nearby) < 0.6 * mean) & (road > 0.5))


def quiet_road(remission, valid, road):
    """Remission in which the road's is its mean, where it differs from it by little more than it does on average."""
    weight = valid * road
    excess = remission - (remission * weight).sum() / max(weight.sum(), 1e-6)
    deviation = (np.abs(excess) * weight).sum() / max(weight.sum(), 1e-6)
    noise = ((3 - np.abs(excess) / max(deviation, 1e-6)) / 1.3).clip(0, 1)
    return remission - weight * noise * excess


def row_means(values, weight, mean, reach, mixed):
    """Weighted means of values beside each other in rows, in which `mean` has the weight `mixed`."""
    sums = np.pad(np.stack([values * weight, weight]), ((0, 0), (0, 0), (reach, reach)), "wrap").cumsum(2)
    total, count = sums[..., 2 * reach :] - np.pad(sums, ((0, 0), (0, 0), (1, 0)))[..., : -2 * reach - 1]
    return (total + mixed * mean) / (count + mixed)


def facades(walls, radius_m, slope, above_m, view):
    """Share of each pixel that is a window or a door (H, W), and the tone of the house of each column (3, W)."""
    rows, columns = radius_m.shape
    azimuth = np.pi - (np.arange(columns) + 0.5) / columns * 2 * np.pi
    ray, focal = np.stack([np.cos(azimuth), np.sin(azimuth)]), columns / (2 * np.pi)
    profile, weight = wall_profile(*(part[::4] for part in (walls, radius_m, radius_m * slope + above_m)))
    point, sums = np.exp(profile) * ray, 0.0
    terms = np.stack([np.ones(columns), *point, point[0] ** 2, point[0] * point[1], point[1] ** 2]) * weight
    for shift in range(-REACH, REACH + 1, 2):  # a line through what is around each column, and as far away
        sums += np.roll(terms, shift, 1) * np.exp(-(((np.roll(profile, shift) - profile) / 0.25) ** 2))
    count = np.maximum(sums[0], 1e-6)
    x, y, xx, xy, yy = sums[1:] / count
    turn = np.arctan2(2 * (xy - x * y), (xx - x * x) - (yy - y * y)) / 2
    facing = np.cos(turn) * ray[1] - np.sin(turn) * ray[0]
    safe = np.where(np.abs(facing) < 0.05, 0.05 * np.sign(facing) + 1e-9, facing)
    radius = (y * np.cos(turn) - x * np.sin(turn)) / safe
    with np.errstate(invalid="ignore", divide="ignore"):
        radius = np.where(np.abs(np.log(radius / np.exp(profile))) < 0.3, radius, np.exp(profile))
    votes = (np.round(turn * 8 / np.pi) % 8 == np.arange(8)[:, None]) * weight
    number = sum(np.roll(votes, shift, 1) for shift in range(-REACH, REACH + 1)).argmax(0)
    run = number * np.pi / 8
    along = ((radius * ray + np.array(view["origin"][:2])[:, None]) * np.stack([np.cos(run), np.sin(run)])).sum(0)
    beyond = y * np.cos(run) > x * np.sin(run)  # of two walls that face each other
    number += ((np.floor(along / HOUSE_M).astype(np.int64) + (1 << 20)) * 2 + beyond) * 8 + 10_000_030
    house, pixel_m = mixed(number), radius / focal
    width_m = pixel_m / np.maximum(np.abs(facing), 0.05)
    elsewhere = (np.abs(radius_m / radius - 1) / 0.25 - 1).clip(0, 1)
    share = openings(house, along % HOUSE_M, slope * radius + above_m, width_m, pixel_m)
    warm = -0.05 + 0.3 * uniform(house, 9)
    return share * (2 * walls).clip(0, 1) * (1 - elsewhere), 2 * uniform(house, 0) - 1 + np.stack(
        [warm, 0.4 * warm, -warm]
    )


def wall_profile(walls, radius_m, height_m):
    """Logarithm of the distance (W,) of each column's wall, and how many rows (W,) it was read from."""
    inside = (height_m > 0.5) & (height_m < 9) & (radius_m < 60)
    profile, total = surface_profile(walls * inside, radius_m, 0.25, 0.3, REACH // 2)
    return np.nan_to_num(profile, nan=np.log(60)), total


def surface_profile(weight, radius_m, same, least, reach):
    """Logarithm of the distance (W,) of each column's surface, NaN where there is none; how many rows show it."""
    distance = np.log(np.maximum(radius_m, 0.5))
    mean = (weight * distance).sum(0) / np.maximum(weight.sum(0), 1e-6)
    weight = weight * np.exp(-(((distance - mean) / same) ** 2))
    total = weight.sum(0)
    found = (weight * distance).sum(0) / np.maximum(total, 1e-6)
    return median_around(np.where(total > least, found, np.nan), reach), total


def median_around(values, reach):
    """The median of the columns within `reach` of each, the lower one of two, NaN left out."""
    around = np.sort([np.roll(values, shift) for shift in range(-reach, reach + 1)], 0)  # NaN last
    middle = np.maximum(np.isfinite(around).sum(0) - 1, 0) // 2
    return np.take_along_axis(around, middle[None], 0)[0]


def openings(house, along_m, level_m, width_m, pixel_m):
    """Share of each pixel (H, W) that is a pane or a door, of walls that are divided into storeys and windows."""
    storey, base = 2.6 + 0.7 * uniform(house, 1), 0.1 + 0.7 * uniform(house, 6)
    count = np.floor(3 + 3 * uniform(house, 4))
    every = HOUSE_M / count
    window, floor = np.floor(along_m / every), np.floor((level_m - base) / storey)
    door = (window == np.floor(count * uniform(house, 7))) & (floor == 0)
    tall = 1.1 + 0.5 * uniform(house, 3)
    middle = np.where(door, 1.0, 0.7 + 0.4 * uniform(house, 2) + tall / 2)
    up, aside = level_m - base - floor * storey - middle, along_m - (window + 0.5) * every
    wide, tall = 0.9 + 0.6 * uniform(house, 5), np.where(door, 2.1, tall)
    across = inside_of(wide / 2 - np.abs(aside), width_m) * (every / width_m / 2 - 1).clip(0, 1)
    there = (floor >= 0) & (floor < np.floor(2 + 3 * uniform(house, 8)))
    there &= uniform(mixed(house + window.astype(np.int64) * 7 + 1), 0) > 0.1
    mullion, transom = bar(aside, width_m) * (uniform(house, 10) >= 0.25), bar(up - tall / 6, pixel_m)
    glass = 1 - ~door * np.maximum(mullion, transom * (uniform(house, 11) >= 0.4))
    return across * inside_of(tall / 2 - np.abs(up), pixel_m) * glass * there


def bar(middle_m, pixel_m):
    """The share of pixels that is a bar that divides a window, so far from its middle: none where bars are too fine."""
    share = inside_of(0.04 - middle_m, pixel_m) - inside_of(-0.04 - middle_m, pixel_m)
    return share * (0.08 / pixel_m - 1).clip(0, 1)


def inside_of(inside_m, pixel_m):
    """The share of pixels that is inside of an edge, so far from their middle."""
    return (0.5 + inside_m / pixel_m).clip(0, 1)


def mixed(number):
    """Whole numbers that look random, of whole numbers."""
    number = number & 0x7FFFFFFF
    number = ((number ^ (number >> 15)) * 0x2C1B3C6D) & 0x7FFFFFFF
    number = ((number ^ (number >> 12)) * 0x297A2D39) & 0x7FFFFFFF
    return number ^ (number >> 15)


def uniform(house, which):
    """Uniform numbers in [0, 1) of houses, one kind for each `which`."""
    return mixed(house * 31 + which * 0x1B873593 + 1) / 0x80000000


def solid_noise(depth_m, sky, view, wavelengths_m):
    """Noise at the points that pixels show, one layer per wavelength, faded out where a pixel could not show it."""
    rows, columns = depth_m.shape
    tile, voxel_m = np.load(HERE / "noise.npy"), min(wavelengths_m) / 4
    slope = slopes(view, rows)
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
