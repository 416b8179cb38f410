"""Flow from ego motion and depth, and from pictures: conventions, occlusion, and what warping along it gives."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from lidar2pano.calibration import Calibration
from lidar2pano.data.semantic_kitti import SemanticKittiFrame
from lidar2pano.errors import InputError
from lidar2pano.geometry.camera import camera_rays
from lidar2pano.geometry.flow import (
    Flow,
    chained,
    ego_flow,
    moved_distances,
    reaches,
    relative_pose,
    scan_distances,
)
from lidar2pano.geometry.projection import directions
from lidar2pano.geometry.rasters import warp
from lidar2pano.views import VIEWS, View

CAMERA = Calibration(
    K=np.array([[60.0, 0, 39.5], [0, 60, 14], [0, 0, 1]]),
    T_camera_lidar=np.array([[0, -1, 0, 0.05], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]]),
    size=(80, 32),
)
AROUND = View(rows=24, columns=180, up=0.24, down=-0.2836, kind="cylinder", origin=(0.27, 0.06, -0.07))
RASTERS = [pytest.param(CAMERA, id="camera"), pytest.param(AROUND, id="panorama")]


def pose(yaw_deg: float, x: float, y: float, z: float = 0.0) -> np.ndarray:
    """(4, 4): a turn to the left and a step, of the LiDAR now in its frame before."""
    cos, sin = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, z], [0, 0, 0, 1]])


MOTION = pose(3.0, 0.9, 0.1, 0.02)


def cast(origin: np.ndarray, ray: np.ndarray) -> float:
    """Distance along a unit vector to road, a house at each side or a board ahead on the left; infinite: the sky."""
    best = math.inf
    if ray[2] < 0:
        best = (-1.73 - origin[2]) / ray[2]
    for side in (7.0, -5.0):
        if ray[1] * side > 0:
            distance = (side - origin[1]) / ray[1]
            if origin[2] + distance * ray[2] < 3.0:
                best = min(best, distance)
    if ray[0] > 0:
        distance = (4.0 - origin[0]) / ray[0]
        y, z = origin[1] + distance * ray[1], origin[2] + distance * ray[2]
        if 1.0 < y < 2.5 and z < 0.5:
            best = min(best, distance)
    return best if best < 250 else math.inf


def looks(raster: View | Calibration) -> tuple[np.ndarray, np.ndarray]:
    """The point that looks (3,) and the directions of the pixels (H, W, 3), in the sensor's frame."""
    if isinstance(raster, View):
        return np.array(raster.origin), directions(raster).double().numpy()
    return np.array(raster.centre), normalize(camera_rays(raster), dim=-1).numpy()


def rendered(raster: View | Calibration, T: np.ndarray) -> torch.Tensor:
    """Distances (H, W) from a sensor that stands at T (4, 4) in the scene."""
    origin, rays = looks(raster)
    start = T[:3, :3] @ origin + T[:3, 3]
    flat = [cast(start, T[:3, :3] @ ray) for ray in rays.reshape(-1, 3)]
    return torch.tensor(flat, dtype=torch.float32).view(rays.shape[:2])


def place_by_hand(point: np.ndarray, raster: View | Calibration) -> tuple[float, float]:
    """Row and column (centres at integers) of one point (3,), sensor frame; NaN behind a camera."""
    if isinstance(raster, View):
        x, y, z = point - np.array(raster.origin)
        turned = (raster.left - math.degrees(math.atan2(y, x))) % 360
        column = turned * raster.columns / (raster.left - raster.right)
        return (raster.up - z / math.hypot(x, y)) * raster.rows / (raster.up - raster.down) - 0.5, column - 0.5
    u, v, depth = raster.K @ (raster.T_camera_lidar @ np.append(point, 1))[:3]
    return (v / depth, u / depth) if depth > 0 else (math.nan, math.nan)


@pytest.fixture(scope="module", params=RASTERS)
def scene(request) -> tuple[View | Calibration, torch.Tensor, torch.Tensor, Flow]:
    """A raster, distances now and before, and the flow between them."""
    raster = request.param
    now, before = rendered(raster, MOTION), rendered(raster, np.eye(4))
    return raster, now, before, ego_flow(now, before, torch.from_numpy(MOTION), raster)


def test_convention_flow_leads_to_where_the_point_was(scene):
    raster, now, _, flow = scene
    origin, rays = looks(raster)
    checked = 0
    for row, column in flow.known.nonzero()[::7].tolist():
        distance = now[row, column].item()
        far = math.isinf(distance)
        point = origin + (1e9 if far else distance) * rays[row, column]
        was = place_by_hand(MOTION[:3, :3] @ point + MOTION[:3, 3], raster)
        shift = np.array([was[1] - column, was[0] - row])
        if isinstance(raster, View):
            shift[0] = (shift[0] + raster.columns / 2) % raster.columns - raster.columns / 2
        assert flow.shift[:, row, column].numpy() == pytest.approx(shift, abs=2e-3), (row, column)
        checked += 1
    assert checked > 150
    assert flow.known.float().mean() > (0.6 if raster is CAMERA else 0.75)


def test_convention_what_comes_nearer_moves_outwards():
    distance = torch.full((32, 80), 10.0)
    ahead = ego_flow(distance, distance + 0.2, torch.from_numpy(pose(0, 0.2, 0)), CAMERA).shift
    assert ahead[0, 16, 70] < 0 < ahead[0, 16, 8]  # backward: from the rim to where it was, nearer the middle
    assert ahead[1, 30, 40] < 0 < ahead[1, 1, 40]
    left = ego_flow(distance, distance, torch.from_numpy(pose(2, 0, 0)), CAMERA).shift
    assert (left[0, 5:-5, 10:60] < 0).all()  # turned to the left, all moves right; it was farther left


def test_what_was_hidden_is_not_known(scene):
    raster, now, before, flow = scene
    origin, rays = looks(raster)
    counts = {"hidden": 0, "wrongly known": 0, "seen": 0, "wrongly unknown": 0}
    for row in range(now.shape[0]):
        for column in range(now.shape[1]):
            if now[row, column].isinf():
                continue
            point = MOTION[:3, :3] @ (origin + now[row, column].item() * rays[row, column]) + MOTION[:3, 3]
            where = place_by_hand(point, raster)
            span = np.linalg.norm(point - origin)
            free = cast(origin, (point - origin) / span)
            rim = min(where[0] + 0.5, now.shape[0] - 0.5 - where[0])
            if not isinstance(raster, View):
                rim = min(rim, where[1] + 0.5, now.shape[1] - 0.5 - where[1])
            inside = rim > 0
            if inside and free < 0.9 * span:
                counts["hidden"] += 1
                counts["wrongly known"] += bool(flow.known[row, column])
            elif inside and free > 0.999 * span:
                counts["seen"] += 1
                counts["wrongly unknown"] += not flow.known[row, column]
            elif rim < -1e-3:
                assert not flow.known[row, column]
    assert counts["hidden"] > 15
    assert counts["wrongly known"] == 0
    assert counts["wrongly unknown"] < 0.12 * counts["seen"]  # edges and folds: no pixel there is one surface


def test_the_panorama_has_no_seam():
    distance = torch.full((AROUND.rows, AROUND.columns), 20.0)
    flow = ego_flow(distance, distance, torch.from_numpy(pose(30, 0, 0)), replaced(AROUND))
    assert flow.known.all()
    assert torch.allclose(flow.shift[0], torch.full_like(flow.shift[0], -15.0), atol=1e-3)
    image = torch.rand(1, 3, AROUND.rows, AROUND.columns)
    was = image.roll(-15, -1)
    assert torch.allclose(warp(was, flow.shift[None], circular=True), image, atol=1e-3)


@pytest.mark.parametrize("align_corners", [True, False])
def test_cubic_samples_have_no_seam_and_keep_more_detail(align_corners):
    wave = torch.sin(torch.arange(48) * 2 * math.pi / 6).expand(1, 1, 5, -1).contiguous()
    half = torch.zeros(1, 2, 5, 48)
    half[:, 0] = 0.5
    cubic, linear = (
        warp(wave, half, circular=True, align_corners=align_corners, cubic=cubic) for cubic in (True, False)
    )
    right = torch.sin((torch.arange(48) + 0.5) * 2 * math.pi / 6)
    off = (cubic[0, 0, 2] - right).abs()
    assert off.max() < 0.25 * (linear[0, 0, 2] - right).abs().max()
    noise = torch.rand(1, 3, 5, 48, generator=torch.Generator().manual_seed(0))
    turned = warp(noise.roll(20, 3), half, circular=True, align_corners=align_corners, cubic=True)
    straight = warp(noise, half, circular=True, align_corners=align_corners, cubic=True)
    assert torch.allclose(turned, straight.roll(20, 3), atol=1e-4)


def replaced(view: View) -> View:
    return View(**{**view.as_dict(), "origin": (0.0, 0.0, 0.0)})


def test_distances_move_with_the_sensor():
    """A slow definition beside it: each pixel's point goes where it is now, and the nearest one stays."""
    before = rendered(AROUND, np.eye(4))
    before[3, 5:9] = 0
    moved = moved_distances(before, torch.from_numpy(np.linalg.inv(MOTION)), AROUND)
    origin, rays = looks(AROUND)
    nearest = np.full(moved.shape, np.inf)
    reached = np.zeros(moved.shape, bool)
    for row, column in (before > 0).nonzero().tolist():
        far = math.isinf(before[row, column])
        point = origin + (1e9 if far else before[row, column].item()) * rays[row, column]
        point = MOTION[:3, :3].T @ (point - MOTION[:3, 3])
        y, x = (math.floor(place + 0.5) for place in place_by_hand(point, AROUND))
        if 0 <= y < AROUND.rows:
            reached[y, x % AROUND.columns] = True
            distance = math.inf if far else float(np.linalg.norm(point - origin))
            nearest[y, x % AROUND.columns] = min(nearest[y, x % AROUND.columns], distance)
    agree = np.isclose(moved.numpy(), nearest, rtol=1e-4) | (moved.isinf().numpy() & np.isinf(nearest))
    assert agree[reached].mean() > 0.995  # but where rounding decides between two pixels
    gaps = (moved == 0).numpy()
    assert gaps.mean() < 0.05 < (~reached).mean()
    none_beside = ~np.isin(np.lib.stride_tricks.sliding_window_view(np.pad(reached, 1, mode="wrap"), (3, 3)), True).any(
        (2, 3)
    )
    assert (gaps[1:-1] == none_beside[1:-1]).all()


def test_the_sky_turns_but_does_not_come_nearer(scene):
    raster, now, _, _ = scene
    sky = torch.full_like(now, math.inf)
    step = ego_flow(sky, sky, torch.from_numpy(pose(0, 5, 1)), raster)
    assert step.known.all() and step.shift.abs().max() < 1e-3
    near = ego_flow(torch.full_like(now, 9.0), sky, torch.from_numpy(pose(0, 0.1, 0)), raster)
    assert not near.known.any(), "before, the sky was there"


def test_unknown_distances_give_no_flow(scene):
    raster, now, before, flow = scene
    for blind_now, blind_before in ((0.0, None), (None, 0.0), (math.nan, None)):
        ours, theirs = now.clone(), before.clone()
        if blind_now is not None:
            ours[:, :20] = blind_now
        if blind_before is not None:
            theirs[:, :20] = blind_before
        blind = ego_flow(ours, theirs, torch.from_numpy(MOTION), raster)
        assert not blind.shift.isnan().any()
        assert blind.known[:, :10].sum() < flow.known[:, :10].sum()
        assert not (blind.known & ~flow.known).any()
    nowhere = torch.zeros_like(now)
    assert not ego_flow(nowhere, before, torch.eye(4), raster).known.any()
    with pytest.raises(ValueError, match="distances must be"):
        ego_flow(now[1:], before, torch.eye(4), raster)


def test_scans_give_distances_and_gaps_are_closed():
    origin, rays = looks(CAMERA)
    ground_truth = rendered(CAMERA, np.eye(4))
    kept = (torch.arange(32)[:, None] % 3 == 0) & (torch.arange(80) % 2 == 0) & ground_truth.isfinite()
    points = torch.from_numpy(origin + ground_truth[kept].double().numpy()[:, None] * rays[kept.numpy()]).float()
    behind = torch.from_numpy(origin + 2 * (points.numpy() - origin)).float()  # what the nearest point hides
    found = scan_distances(torch.cat([behind, points, -points]), CAMERA)
    assert torch.allclose(found[kept], ground_truth[kept], rtol=1e-4)
    road = torch.zeros_like(kept)
    road[24:30, 45:76] = True
    assert ((found - ground_truth).abs() / ground_truth)[road].mean() < 0.02
    alone = scan_distances(points[:1], CAMERA)
    assert 0 < (alone > 0).sum() < alone.numel(), "far from every point nothing is known"


def test_chained_flows_lead_over_two_steps():
    later = Flow(shift=torch.tensor([2.0, 1.0])[None, :, None, None].expand(1, 2, 8, 12), known=torch.ones(1, 8, 12))
    earlier = Flow(shift=torch.zeros(1, 2, 8, 12), known=torch.ones(1, 8, 12))
    earlier.shift[:, 0], earlier.known[0, 3, 7] = -5.0, 0
    both = chained(later, earlier)
    assert both.known[0, 2, 5] == 0 and both.known[0, 2, 6] == 1
    assert not both.known[0, 7].any() and not both.known[0, :, :3].any(), "they lead out of the picture"
    known = both.known[0] > 0
    assert (both.shift[0, 0][known] == -3).all() and (both.shift[0, 1][known] == 1).all()
    assert (both.shift[0, :, ~known] == 0).all()
    assert chained(later, earlier, circular=True).known[0, :7, :3].all()


def test_an_image_ends_half_a_pixel_beyond_its_last_centres():
    shift = torch.zeros(1, 2, 3, 4)
    shift[0, 0, 0], shift[0, 0, 1], shift[0, 1, 2] = 0.75, 0.25, -2.25
    assert reaches(shift)[0].tolist() == [[True, True, True, False], [True] * 4, [True] * 4]
    assert reaches(-shift)[0].tolist() == [[False, True, True, True], [True] * 4, [False] * 4]
    assert reaches(shift, circular=True).all() and not reaches(-shift, circular=True)[0, 2].any()


def write_sequence(folder: Path, poses: list[np.ndarray]) -> list[SemanticKittiFrame]:
    P2 = "P2: 700 0 600 45 0 700 170 0.2 0 0 1 0.003\n"
    (folder / "calib.txt").write_text(P2 + "Tr: 0 -1 0 0.01 0 0 -1 -0.08 1 0 0 -0.27\n")
    (folder / "poses.txt").write_text("".join(" ".join(map(str, T[:3].ravel())) + "\n" for T in poses))
    return [SemanticKittiFrame(folder, f"{number:06d}") for number in range(len(poses))]


def T_before_now(before: SemanticKittiFrame, now: SemanticKittiFrame) -> torch.Tensor:
    assert before.pose is not None and now.pose is not None
    return relative_pose(before.pose, now.pose)


def test_poses_are_of_camera_0(tmp_path):
    first, second = pose(10, 1, 2), pose(40, 3, -1)
    one, other = write_sequence(tmp_path, [first, second])
    Tr = np.array([[0, -1, 0, 0.01], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])
    found = T_before_now(one, other)
    for now in np.array([[4.0, 1, 2, 1], [-3, 5, 1, 1]]):
        there = second @ Tr @ now  # where it stands, in the first camera's frame
        assert first @ Tr @ found.numpy() @ now == pytest.approx(there)
    (tmp_path / "poses.txt").unlink()
    assert SemanticKittiFrame(tmp_path, one.stem).pose is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1 2 3\n", "12 finite numbers"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", "none for frame 000001"),
        ("a\n", "cannot be read"),
    ],
)
def test_damaged_poses_are_named(tmp_path, content, message):
    one, other = write_sequence(tmp_path, [np.eye(4)] * 2)
    (tmp_path / "poses.txt").write_text(content)
    with pytest.raises(InputError, match=f"poses.txt: .*{message}"):
        T_before_now(one, other)


def test_flow_between_images():
    pytest.importorskip("cv2", reason="flow between pictures needs opencv: pip install 'lidar2pano[train]'")
    from lidar2pano.data.clips import optical_flow
    from miniature_video import texture

    wide = torch.from_numpy(texture(0, 80, 200)).movedim(2, 0)
    before, now = wide[:, 4:68, 10:170].contiguous(), wide[:, 2:66, 13:173].contiguous()  # it moved left and down
    flow = optical_flow(now, before)
    middle = (slice(8, 56), slice(8, 152))
    assert flow.known[middle].float().mean() > 0.95
    assert flow.shift[0][middle][flow.known[middle]].median() == pytest.approx(3, abs=0.2)
    assert flow.shift[1][middle][flow.known[middle]].median() == pytest.approx(-2, abs=0.2)
    assert not flow.known[:, -2:].any(), "it came into view"
    unlike = optical_flow(now, torch.from_numpy(texture(1, 64, 160)).movedim(2, 0))
    assert unlike.known.float().mean() < 0.5


def test_without_opencv_its_installation_is_suggested(monkeypatch):
    from lidar2pano.data.clips import optical_flow

    monkeypatch.setitem(sys.modules, "cv2", None)
    image = torch.zeros(3, 8, 8, dtype=torch.uint8)
    with pytest.raises(InputError, match=r"needs the extra 'train': pip install 'lidar2pano\[train\]'"):
        optical_flow(image, image)


def test_a_rendered_image_is_the_one_before_it_warped(tmp_path):
    pytest.importorskip("embreex", reason="the street world needs embreex: pip install 'lidar2pano[world]'")
    from lidar2pano.simulate.generation import SequenceWriter
    from lidar2pano.simulate.settings import WorldSettings

    settings = WorldSettings(seed=5, frames=2, place="motorway", save=("panorama",), views=("panorama/4",))
    writer = SequenceWriter(tmp_path, settings, 0)
    writer.prepare()
    before, now = (dict(writer.images(frame))["panorama/4"] for frame in (0, 1))
    one, other = (SemanticKittiFrame(tmp_path, f"{frame:06d}") for frame in (0, 1))
    found = T_before_now(one, other)
    distances = [torch.from_numpy(image.distance) for image in (now, before)]
    flow = ego_flow(distances[0], distances[1], found, VIEWS["panorama"].scaled(1 / 4))
    colours = [torch.from_numpy(image.image).movedim(2, 0)[None].float() for image in (now, before)]
    assert flow.known.float().mean() > 0.6

    def gap(image: torch.Tensor) -> float:
        return (image - colours[0]).abs().mean(1)[0][flow.known].mean().item()

    still = gap(colours[1])
    warped = gap(warp(colours[1], flow.shift[None], circular=True))
    assert still > 5 and warped < 0.5 * still, (still, warped)
    assert gap(warp(colours[1], -flow.shift[None], circular=True)) > still, "the other way round it is worse"
