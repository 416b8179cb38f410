"""PointCloud2 messages of ROS, as objects with the attributes of sensor_msgs/PointCloud2, from whatever library."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar2pano.errors import InputError
from lidar2pano.formats.point_cloud import MOST_POINTS, PointCloud, cloud_of_columns

# sensor_msgs/PointField.datatype
DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def is_point_cloud2(message: object) -> bool:
    """Return whether an object has the attributes of a PointCloud2."""
    return all(hasattr(message, name) for name in ("fields", "point_step", "width", "height", "data"))


def cloud_of_message(message: Any, name: str = "message") -> PointCloud:  # noqa: ANN401
    """Return the points of a PointCloud2: any fields and offsets, both byte orders, padded rows.

    Stamp and frame are those of its header. Raises InputError if its numbers do not fit its data.
    """
    columns = message_columns(message, name)
    header = getattr(message, "header", None)
    stamp = getattr(header, "stamp", None)
    whole = getattr(stamp, "sec", getattr(stamp, "secs", None))
    parts = getattr(stamp, "nanosec", getattr(stamp, "nsec", getattr(stamp, "nsecs", 0)))
    return cloud_of_columns(
        columns,
        format="PointCloud2",
        name=name,
        frame=str(getattr(header, "frame_id", "")),
        stamp_s=None if whole is None else whole + parts * 1e-9,
    )


def message_columns(message: Any, name: str) -> dict[str, np.ndarray]:  # noqa: ANN401
    """Return the fields of a PointCloud2: name -> (height * width,) of its type; only those of one value."""
    data = np.frombuffer(bytes(message.data) if isinstance(message.data, list) else message.data, dtype=np.uint8)
    rows, width, step = int(message.height), int(message.width), int(message.point_step)
    stride = int(getattr(message, "row_step", 0)) or width * step
    if rows * width > MOST_POINTS:
        raise InputError(f"{name}: {rows * width} points are no single sweep (at most {MOST_POINTS}); cut it")
    if rows * width == 0:
        raise InputError(f"{name}: holds no points; name a scan that has some")
    if step < 1 or stride < width * step or (rows - 1) * stride + width * step > len(data):
        raise InputError(
            f"{name}: {len(data)} bytes do not hold {rows} x {width} points of {step} bytes; the message is damaged"
        )
    order = ">" if message.is_bigendian else "<"
    columns = {}
    for field in message.fields:
        if int(getattr(field, "count", 1)) > 1 or int(field.datatype) not in DATATYPES:
            continue
        dtype = np.dtype(order + DATATYPES[int(field.datatype)])
        offset = int(field.offset)
        if not 0 <= offset <= step - dtype.itemsize:
            raise InputError(f"{name}: field {field.name!r} lies outside its points; the message is damaged")
        values = np.ndarray((rows, width), dtype, data.data, offset, (stride, step))
        columns[field.name] = values.reshape(-1)
    return columns
