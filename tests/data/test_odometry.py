"""Poses of scans: read from poses.txt, else estimated from the scans."""

import numpy as np
import pytest

from lidar2pano.data.layouts import frames
from lidar2pano.drives.reading import posed_scans
from lidar2pano.formats.scan_files import write_bin
from lidar2pano.scan import Scan


def room(pose):
    """A scan of a room of walls, floor and posts, by a sensor whose pose (4, 4) is given."""
    generator = np.random.default_rng(7)
    walls = [
        np.stack([generator.uniform(-20, 20, 4000), np.full(4000, side), generator.uniform(-1.5, 4, 4000)], 1)
        for side in (-8.0, 11.0)
    ]
    walls += [
        np.stack([np.full(3000, end), generator.uniform(-8, 11, 3000), generator.uniform(-1.5, 4, 3000)], 1)
        for end in (-20.0, 20.0)
    ]
    floor = np.stack([generator.uniform(-20, 20, 6000), generator.uniform(-8, 11, 6000), np.full(6000, -1.5)], 1)
    world = np.concatenate([*walls, floor])
    xyz = (world - pose[:3, 3]) @ pose[:3, :3]
    return Scan(xyz=xyz.astype(np.float32), remission=np.zeros(len(xyz), np.float32))


def test_motion_is_estimated_from_scans(tmp_path):
    pytest.importorskip("kiss_icp", reason="poses are estimated by KISS-ICP: pip install 'lidar2pano[recordings]'")
    poses = []
    for number in range(8):
        pose, angle = np.eye(4), 0.01 * number
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[0, 3] = 0.5 * number
        scan = room(pose)
        scan.xyz[5] = np.nan
        write_bin(tmp_path / f"{number}.bin", scan)
        poses.append(pose)
    found = [T for _, T in posed_scans(tmp_path)]
    (was, before), (now, here) = ((poses[number], found[number]) for number in (3, 7))
    true, estimated = np.linalg.inv(was) @ now, np.linalg.inv(before) @ here
    assert np.allclose(estimated[:3, 3], true[:3, 3], atol=0.1)
    assert np.allclose(estimated[:3, :3], true[:3, :3], atol=0.005)


def test_a_real_drive_goes_ahead(kitti_mini):
    pytest.importorskip("kiss_icp", reason="poses are estimated by KISS-ICP: pip install 'lidar2pano[recordings]'")
    drive = frames(kitti_mini, "drive")
    found = [T for _, T in posed_scans(drive[0].folder / "velodyne")]
    steps = np.array([np.linalg.inv(a) @ b for a, b in zip(found[3:], found[4:], strict=False)])
    assert (steps[:, 0, 3] > 0.1).all() and (steps[:, 0, 3] < 0.5).all(), "metres in a tenth of a second"
    assert np.abs(steps[:, 1:3, 3]).max() < 0.1
