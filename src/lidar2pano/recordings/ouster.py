"""Ouster captures (.pcap with its metadata .json) and .osf files, by ouster-sdk if installed.

ouster-sdk pins old versions of libraries of the extra `recordings`; therefore no extra of this package installs it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.point_cloud import PointCloud, cloud_of_columns
from lidar2pano.recordings.description import Description, Topic, damage

OSF = b"OSF!"  # at byte 4 of a FlatBuffers file, 8 if its size comes before
REPAIR = "it needs the sensor's metadata .json beside it (ouster-cli source FILE info)"


def is_osf(head: bytes) -> bool:
    """Return whether a file is an OSF, by its first bytes."""
    return OSF in (head[4:8], head[8:12])


def scans(path: Path) -> Iterator[Any]:
    """Yield the LidarScans of all sensors of a file, in time; InputError without ouster-sdk, or if it is damaged."""
    try:
        from ouster.sdk import open_source  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(
            f"{path}: holds Ouster packets, not points; they are decoded where ouster-sdk is installed"
            " (pip install ouster-sdk, in an environment without rosbags), or convert them to a PCD, LAS or bag"
        ) from error
    with damage(path, REPAIR):
        source = open_source(str(path))
        try:
            for together in source:
                yield from (scan for scan in together if scan is not None)
        finally:
            source.close()


def stamp_s(scan: Any) -> float:  # noqa: ANN401
    """Return the time of the first column, seconds by the sensor's clock; 0 without any."""
    stamps_ns = np.asarray(scan.timestamp)
    return float(stamps_ns[stamps_ns > 0].min(initial=2**63)) * 1e-9 if stamps_ns.any() else 0.0


def describe(path: Path) -> Description:
    """Return the description of an OSF; InputError as `scans`."""
    stamps_s = [stamp_s(scan) for scan in scans(path)]
    topic = Topic(name="lidar", type="Ouster packets", count=len(stamps_s))
    return Description(
        format="OSF",
        topics=(topic,),
        first_ns=round(min(stamps_s, default=0) * 1e9),
        last_ns=round(max(stamps_s, default=0) * 1e9),
    )


def cloud_of_scan(scan: Any, name: str) -> PointCloud:  # noqa: ANN401
    """Return the points of a LidarScan in the sensor's frame: beam after beam; no return is at the origin."""
    from ouster.sdk.core import XYZLut  # pyright: ignore[reportMissingImports]

    xyz = XYZLut(scan.sensor_info, use_extrinsics=False)(scan.field("RANGE")).reshape(-1, 3)
    stamps_ns = np.asarray(scan.timestamp)
    start_s = stamp_s(scan)
    if not start_s:
        raise InputError(f"{name}: holds no points; name a scan that has some")
    columns = dict(zip("xyz", xyz.T.astype(np.float32), strict=True))
    for field in ("REFLECTIVITY", "SIGNAL"):
        if field in scan.fields:
            columns["intensity"] = np.asarray(scan.field(field)).reshape(-1)
            break
    columns["ring"] = np.repeat(np.arange(scan.h), scan.w)
    columns["offset_ns"] = np.tile(stamps_ns.astype(np.int64) - round(start_s * 1e9), scan.h)
    return cloud_of_columns(columns, format="Ouster packets", name=name, frame="os_sensor", stamp_s=start_s)
