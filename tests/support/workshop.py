"""A working folder with everything that the documentation's commands read, made from the demo's scan."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from PIL import Image

from lidar2pano import demo
from lidar2pano.models import build
from lidar2pano.scan import Scan
from map_street import street_points, write_las
from miniature_recordings import START_NS, STEP_NS, odometry, points, write
from sample_files import pcd, ply

CALIB = """P2: 718.856 0 607.1928 45.38225 0 718.856 185.2157 -0.1130887 0 0 1 0.003779761
Tr: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27
"""
CAMERA_YAML = """image_width: 480
image_height: 300
camera_matrix: {rows: 3, cols: 3, data: [300, 0, 240, 0, 300, 144, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.01, 0.001, -0.002, 0]}
T_camera_lidar: [0, -1, 0, 0, 0, 0, -1, -0.08, 1, 0, 0, -0.27, 0, 0, 0, 1]
"""
POSES = "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 1\n"
CLOUDS = ("scan.bin", "a.bin", "b.bin", "drive/000000.bin", "drive/000001.bin", "incoming/000000.bin")
CLOUDS += ("SCANS/town/000000.bin", "SCANS/000001.bin", "drives/a/000000.bin", "drives/b/000000.bin")
CLOUDS += ("data/drives/000000.bin", "drive/velodyne/000000.bin", "drive/velodyne/000001.bin")
CLOUDS += tuple(f"{root}/sequences/00/velodyne/{n:06d}.bin" for root in ("drive", "semantickitti") for n in range(2))


def write_workshop(folder: Path) -> Path:
    """Write the inputs into a folder that exists; returns the folder."""
    for name in CLOUDS:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(demo.street(), path)
    (folder / "calib.txt").write_text(CALIB)
    (folder / "calib.yaml").write_text(CAMERA_YAML)
    Image.fromarray(np.tile(np.uint8(120), (300, 480, 3))).save(folder / "photo.jpg")
    Image.fromarray(np.zeros((300, 480), dtype=np.uint8)).save(folder / "mask.png")
    table = np.fromfile(demo.street(), "<f4").reshape(-1, 4)
    xyz, remission = table[:, :3], table[:, 3]
    for sequence in ("drive/sequences/00", "semantickitti/sequences/00"):
        (folder / sequence / "calib.txt").write_text(CALIB)
        (folder / sequence / "poses.txt").write_text(POSES)
        (folder / sequence / "times.txt").write_text("0.0\n0.1\n")
    (folder / "semantickitti/sequences/00/labels").mkdir()
    for number in range(2):
        labels = np.full(len(xyz), 40, "<u4")  # road
        labels.tofile(folder / f"semantickitti/sequences/00/labels/{number:06d}.label")
    (folder / "scan.pcd").write_bytes(pcd(xyz, remission))
    (folder / "other.ply").write_bytes(ply(xyz, remission))
    np.savez(folder / "merged.npz", points=table)
    scan = Scan(xyz=xyz.copy(), remission=remission.copy())
    map_xyz, _ = street_points(0.2)
    write_las(folder / "map.laz", map_xyz)
    (folder / "places.csv").write_text("x,y,z\n12.5,-3,1.8\n11.5,-3,1.8\n")
    (folder / "tiles").mkdir()
    write_las(folder / "tiles" / "utm.laz", map_xyz + (512340.2 - 12.5, 5403107 + 3, 412.6 - 1.8))
    for form in ("bag", "mcap", "db3"):
        write(folder, form, _drive(scan))
    write(folder / "drives", "mcap", _drive(scan), "recorded")
    return folder


def _drive(scan: Scan):
    """Yield two sweeps a tenth of a second apart and the poses around them, and one sweep ten seconds later."""
    for tenths in (0, 1, 100):
        stamp_ns = START_NS + tenths * STEP_NS
        yield odometry(stamp_ns, (0.1 * tenths, 0, 0, 0, 0, 0, 1))
        yield points(scan, stamp_ns, "/lidar/points")


def write_published(folder: Path) -> None:
    """Write untrained stand-ins of the authors' files of SalsaNext and TITAN-Net, in full size and in their form."""
    import torch

    networks = {"SalsaNext": build("salsanext", classes=20, channels=5), "titan.pth": build("titan")}
    for name, network in networks.items():
        state = {f"module.{key}": value for key, value in network.state_dict().items()}
        torch.save({"state_dict": state}, folder / name)
