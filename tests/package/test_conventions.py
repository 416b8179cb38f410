"""One test for each sentence of CONVENTIONS.md."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from lidar2pano.calibration import Calibration
from lidar2pano.data.frames import IGNORE
from lidar2pano.data.layouts import frames
from lidar2pano.data.panorama_crops import PanoramaDataset
from lidar2pano.data.photographs import PhotographDataset
from lidar2pano.data.poses import lidar_poses
from lidar2pano.errors import InputError
from lidar2pano.formats.readers import read
from lidar2pano.formats.scan_files import read_label, write_bin, write_label
from lidar2pano.geometry.camera import at_camera, points_in_camera
from lidar2pano.geometry.projection import Normalisation, directions, pixels, project
from lidar2pano.labels import COMMON14, COMMON15, SEMANTIC_KITTI, LabelSet, unpack_label
from lidar2pano.metrics.confusion import MeanIoU
from lidar2pano.pipeline.segmenter import clean_up
from lidar2pano.scan import Scan
from lidar2pano.views import VIEWS, View

PAGE = Path(__file__).resolve().parents[2] / "CONVENTIONS.md"
SENSOR = VIEWS["hdl64e"]
FRONT = replace(SENSOR, columns=512, left=45, right=-45)
# straight ahead, x right, y down
CAMERA = Calibration(
    K=np.array([[100.0, 0, 49.5], [0, 100, 19.5], [0, 0, 1]]),
    T_camera_lidar=np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, -0.25], [0, 0, 0, 1]]),
    size=(100, 40),
)


def scan_of(*points: tuple[float, float, float]) -> Scan:
    xyz = np.array(points, dtype=np.float32).reshape(-1, 3)
    return Scan(xyz=xyz, remission=np.linspace(0.25, 0.75, len(xyz), dtype=np.float32))


def place(point: tuple[float, float, float], view: View = SENSOR) -> tuple[int, int]:
    image = project(scan_of(point), view)
    return int(image.row[0]), int(image.column[0])


def test_every_convention_names_its_test_and_every_test_its_convention():
    listed = re.findall(r"^(\d+)\. .*[.] `(test_convention_\w+)`$", PAGE.read_text(encoding="utf-8"), flags=re.M)
    here = [name for name in globals() if name.startswith("test_convention_")]
    assert [name for _, name in listed] == here
    assert [int(number) for number, _ in listed] == list(range(1, len(here) + 1))
    sentences = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if re.match(r"[-*\d]", line)]
    assert len(sentences) == len(here), "a listed sentence without its test"


def test_convention_x_forward_y_left_z_up():
    middle = SENSOR.columns // 2
    assert place((10, 0, 0))[1] == middle
    assert place((10, 1, 0))[1] < middle < place((10, -1, 0))[1]
    assert place((10, 0, 0.2))[0] < place((10, 0, 0))[0]


def test_convention_columns_run_from_left_to_right():
    columns = [place((math.cos(math.radians(a)), math.sin(math.radians(a)), 0))[1] for a in (179, 90, 0, -90, -179)]
    assert columns == [5, 512, 1024, 1536, 2042]


def test_convention_straight_behind_is_the_first_column():
    assert place((-10, 0.0, 0))[1] == place((-10, -0.0, 0))[1] == 0


def test_convention_rows_run_from_the_top_down():
    rows = [place((10, 0, 10 * math.tan(math.radians(degrees))))[0] for degrees in (2.9, 0, -10, -24.9)]
    assert rows[0] == 0 and rows == sorted(rows) and rows[-1] == 63


def test_convention_pixels_begin_at_their_corner():
    view = View(rows=4, columns=8, up=1.0, down=-1.0, kind="cylinder")
    row, column = pixels(*directions(view)[1, 2], view)
    assert (float(row), float(column)) == pytest.approx((1.5, 2.5), abs=1e-6)
    assert place((10, 0, 0), view) == (2, 4), "on the edge of two pixels: the later one"


def test_convention_camera_pixels_are_centred_at_integers():
    u, v, _ = points_in_camera(torch.tensor([[10.25, -1.0, -0.5], [10.25, 0, 0]]), CAMERA)
    assert (u.tolist(), v.tolist()) == ([59.5, 49.5], [24.5, 19.5]), "the middle of 100 x 40 pixels is (49.5, 19.5)"


def test_convention_rows_of_spheres_and_cylinders():
    sphere = View(rows=6, columns=8, up=30, down=-30)
    cylinder = View(rows=6, columns=8, up=0.6, down=-0.6, kind="cylinder")
    elevation, slope = (rays[:, 0, 2] / rays[:, 0, :2].norm(dim=1) for rays in map(directions, (sphere, cylinder)))
    torch.testing.assert_close(elevation.atan().rad2deg(), torch.tensor([25.0, 15, 5, -5, -15, -25]))
    torch.testing.assert_close(slope, torch.tensor([0.5, 0.3, 0.1, -0.1, -0.3, -0.5]))


def test_convention_panorama_pixels_are_square_at_the_horizon():
    view = VIEWS["panorama"]
    assert view.kind == "cylinder" and view.rows / (view.up - view.down) == pytest.approx(view.focal_px, rel=1e-4)


def test_convention_the_panorama_looks_from_the_camera():
    view = at_camera(VIEWS["panorama"], CAMERA)
    assert view.origin == (0.25, 0, 0)
    assert project(scan_of((10.25, 0, 0)), view).channels.amax((1, 2)).tolist()[:2] == [10, 10]


def test_convention_a_turn_is_a_shift():
    generator = np.random.default_rng(0)
    view = replace(VIEWS["panorama"].scaled(0.0625), origin=(0.0, 0.0, 0.0))
    column = generator.integers(0, view.columns, 300)
    azimuth = math.pi - (column + 0.5) / view.columns * 2 * math.pi
    heights, ranges = generator.uniform(-0.2, 0.2, 300), generator.uniform(2, 60, 300)

    def turned(turn: float) -> torch.Tensor:
        flat = np.stack([np.cos(azimuth + turn), np.sin(azimuth + turn), heights], axis=1) * ranges[:, None]
        return project(scan_of(*flat.tolist()), view).index

    assert torch.equal(turned(math.radians(30)), turned(0.0).roll(-view.columns // 12, dims=1))


def test_convention_channels():
    image = project(scan_of((3, 4, 0)), SENSOR)
    torch.testing.assert_close(image.channels[:, image.valid][:, 0], torch.tensor([5.0, 3, 4, 0, 0.25]))


def test_convention_channels_are_relative_to_the_origin():
    image = project(scan_of((3, 4, 2)), replace(SENSOR, origin=(0.0, 0.0, 2.0)))
    torch.testing.assert_close(image.channels[:, image.valid][:, 0], torch.tensor([5.0, 3, 4, 0, 0.25]))
    assert image.range_m.tolist() == [5]


def test_convention_missing_is_a_mask():
    image = project(scan_of((10, 0, 0)), SENSOR)
    assert image.valid.dtype == torch.bool and image.valid.sum() == 1
    assert (image.index[~image.valid] == -1).all() and not image.channels[:, ~image.valid].any()


def test_convention_empty_pixels_are_zero_after_normalisation():
    image = project(scan_of((10, 0, 0)), SENSOR)
    normal = Normalisation(mean=(1, 2, 3, 4, 5), deviation=(2,) * 5)(image)
    assert normal[:, image.valid][:, 0].tolist() == [4.5, 4, -1.5, -2, -2.375]
    assert not normal[:, ~image.valid].any()


def test_convention_what_is_out_of_view_is_gone():
    points = ((-10, 0, 0), (0, 10, 0), (0, -10, 0), (10, 0, 9), (10, 0, -9), (0, 0, 5), (0, 0, -5))
    image = project(scan_of(*points), FRONT)
    assert not image.valid.any() and not image.inside.any() and image.dropped == 0


def test_convention_the_nearest_point_owns_its_pixel():
    far, near = (20, 0, 0), (10, 0, 0)
    for points, owner in (((far, near, far), 1), ((near, far), 0)):
        assert project(scan_of(*points), SENSOR).index.max() == owner


def test_convention_at_equal_range_the_first_point_wins():
    far, near = (20, 0, 0), (10, 0, 0)
    for points, owner in (((far, near, near), 1), ((near,) * 5, 0)):
        assert project(scan_of(*points), SENSOR).index.max() == owner


def test_convention_point_zero_fills_its_pixel():
    image = project(scan_of((10, 0, 0)), SENSOR)
    assert image.valid.sum() == 1 and image.index[image.valid].tolist() == [0]


def test_convention_unusable_points_are_counted():
    nan, inf = math.nan, math.inf
    scan = scan_of((10, 0, 0), (nan, 1, 0), (inf, 0, 0), (0, -inf, 0), (0, 0, 0), (3e38, 3e38, 0), (0, 10, 0))
    image = project(scan, SENSOR)
    assert image.dropped == 5 and image.usable.tolist() == [True, False, False, False, False, False, True]
    assert image.valid.sum() == 2 and image.channels.isfinite().all()
    assert image.range_m.tolist() == [10, 0, 0, 0, 0, 0, 10]


def test_convention_points_keep_their_order():
    image = project(scan_of((0, 0, 0), (10, 0, 0), (0, 10, 0), (-10, 0, 9)), SENSOR)
    ids = image.spread(torch.tensor([0, 4, 7, 0]))
    assert clean_up(image, ids).tolist() == [0, 4, 7, 0]
    assert len(image.row) == len(image.column) == len(image.range_m) == 4


def test_convention_class_zero_is_unlabeled():
    assert {labels.classes[0] for labels in (SEMANTIC_KITTI, COMMON14, COMMON15)} == {"unlabeled"}
    assert COMMON15.classes == (*COMMON14.classes, "sky") and len(COMMON14) == 15
    assert COMMON14.classes[1:] == (
        "car", "bicycle", "motorcycle", "truck", "other-vehicle", "person", "road", "sidewalk", "building", "fence",
        "vegetation", "terrain", "pole", "traffic-sign",
    )  # fmt: skip


def test_convention_labels_are_mapped_by_name():
    theirs = LabelSet(name="theirs", classes=("road", "car", "tram"), colours=((0, 0, 0),) * 3)
    assert theirs.table_to(COMMON14, {"tram": "other-vehicle"}).tolist() == [7, 1, 5]


def test_convention_a_lost_class_is_an_error():
    theirs = LabelSet(name="theirs", classes=("road", "tram"), colours=((0, 0, 0),) * 2)
    with pytest.raises(ValueError, match=r"theirs -> common-14: say where \['tram'\] go"):
        theirs.table_to(COMMON14, {})


def test_convention_moving_classes_fold():
    moving = [SEMANTIC_KITTI.classes[i] for i in SEMANTIC_KITTI.from_raw(np.arange(252, 260))]
    assert set(moving) == {"car", "bicyclist", "person", "motorcyclist", "other-vehicle", "truck"}
    assert (
        SEMANTIC_KITTI.from_raw(np.array([252, 254])).tolist() == SEMANTIC_KITTI.from_raw(np.array([10, 30])).tolist()
    )


def test_convention_label_bits(tmp_path: Path):
    values = np.array([0x0003_0028], dtype="<u4")
    class_id, instance = unpack_label(values)
    assert (class_id.tolist(), instance.tolist()) == ([40], [3])
    values.tofile(tmp_path / "a.label")
    assert [SEMANTIC_KITTI.classes[i] for i in read_label(tmp_path / "a.label", 1)] == ["road"]


def small_data(root: Path, grey: int, label: int) -> Path:
    """A data set of one frame: a plain picture, one class, some points ahead."""
    folder = root / "sequences" / "00"
    for name in ("velodyne", "labels", "image_2", "camera_labels"):
        (folder / name).mkdir(parents=True)
    write_bin(folder / "velodyne" / "000000.bin", scan_of((10, 0, 0), (10, 1, 0)))
    write_label(folder / "labels" / "000000.label", np.array([1, 9]))
    Image.fromarray(np.full((40, 100, 3), grey, np.uint8)).save(folder / "image_2" / "000000.png")
    Image.fromarray(np.full((40, 100), label, np.uint8)).save(folder / "camera_labels" / "000000.png")
    K = "100 0 49.5 0 0 100 19.5 0 0 0 1 0"
    (folder / "calib.txt").write_text(f"P2: {K}\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 -0.25\n", encoding="utf-8")
    (root / "splits.json").write_text(json.dumps({"train": ["00/000000"]}), encoding="utf-8")
    return root


def test_convention_255_is_ignored(tmp_path: Path):
    assert IGNORE == 255
    sample = PanoramaDataset(small_data(tmp_path, 0, 255), ("train",), VIEWS["panorama"].scaled(0.125), 128)[0]
    assert sample.camera_labels.unique().tolist() == [255]


def test_convention_the_clean_up_invents_nothing():
    image = project(scan_of((10, 0, 0), (0, 10, 0)), SENSOR)
    assert clean_up(image, image.spread(torch.tensor([0, 4]))).tolist() == [0, 4]


def test_convention_miou_counts_first_and_averages_last():
    split = MeanIoU(3)
    for name, predicted, target in (("a", [1, 1, 1, 1], [1, 1, 1, 1]), ("b", [1, 2], [2, 2])):
        split.update(np.array(predicted), np.array(target), name)
    assert split.compute() == pytest.approx((4 / 5 + 1 / 2) / 2), "the mean over images would be (1 + 1/4) / 2"


def test_convention_unlabeled_ground_truth_is_not_scored():
    split = MeanIoU(COMMON14, unscored=(0,))
    split.update(np.array([1, 1, 0, 2]), np.array([0, 1, 1, 2]), "a")
    assert split.compute() == pytest.approx((1 / 2 + 1) / 2)


@pytest.mark.parametrize(("grey", "inside"), [(0, -1.0), (255, 1.0)])
def test_convention_rgb(tmp_path: Path, grey, inside):
    root = small_data(tmp_path, grey, 0)
    outside = frames(root, "train")[0].require("image")[0]
    assert outside.dtype == np.uint8 and outside.shape == (40, 100, 3)
    crop = PhotographDataset(root, ("train",), 32)[0]
    assert crop.image.dtype == torch.float32 and crop.image.unique().tolist() == [inside]


def test_convention_a_mistake_is_one_line(tmp_path: Path):
    (tmp_path / "a.bin").write_bytes(b"no scan")
    for name in ("a.bin", "b.bin", "a.xyz"):
        with pytest.raises(InputError) as caught:
            read(tmp_path / name)
        assert str(caught.value).startswith(f"{tmp_path / name}: ") and "\n" not in str(caught.value)


def test_convention_poses_carry_to_where_things_stand(tmp_path: Path):
    """The car drives two metres ahead: a post that was five metres ahead is three ahead, at the same place."""
    Tr = "Tr: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3\n"
    (tmp_path / "calib.txt").write_text("P2: 700 0 600 0 0 700 170 0 0 0 1 0\n" + Tr)
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 2\n")
    poses = lidar_poses(tmp_path)
    assert poses is not None
    assert poses.at("000000") @ [5, 0, 0, 1] == pytest.approx(poses.at("000001") @ [3, 0, 0, 1])


def test_convention_the_vehicle_itself_is_masked():
    scan = scan_of((0.99, 0, 0), (0, -1.01, 0), (0.6, 0.6, 0.6), (0.5, -0.5, 0.5), (10, 0, 0), (math.nan, 0, 0))
    image = project(scan.beyond(), SENSOR)
    assert image.usable.tolist() == [False, True, True, False, True, False]  # the third is 1.04 m away
    assert np.isnan(scan_of((1.9, 0, 0), (0, 2.1, 0)).beyond(2).xyz[:, 0]).tolist() == [True, False]
    assert len(scan.beyond()) == len(scan) and project(scan, SENSOR).dropped == 1, "the scan itself keeps all"
