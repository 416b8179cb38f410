"""Messages of sensor_msgs from arrays, without ROS: each function fills an empty message and returns it."""

from __future__ import annotations

import io
from array import array
from collections.abc import Callable
from typing import Any

import numpy as np
from PIL import Image

from lidar2pano import Calibration, View

CYLINDRICAL = "cylindrical"
ENCODINGS = {("u1", 3): "rgb8", ("u1", 1): "8UC1", ("f4", 1): "32FC1"}
FLOAT32, UINT16 = 7, 4  # of sensor_msgs/PointField
POINT = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("rgb", "<u4"), ("label", "<u2")]
JPEG_QUALITY = 90


def fill_image(message: Any, header: Any, pixels: np.ndarray) -> Any:
    """Fill an Image with pixels (h, w, 3) or (h, w), of uint8 or float32."""
    message.header = header
    message.height, message.width = pixels.shape[:2]
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    message.encoding = ENCODINGS[pixels.dtype.str[1:], channels]
    message.is_bigendian, message.step = 0, pixels.shape[1] * channels * pixels.itemsize
    message.data = array("B", pixels.tobytes())  # which rclpy takes without a look at each byte
    return message


def fill_compressed(message: Any, header: Any, colour: np.ndarray) -> Any:
    """Fill a CompressedImage with RGB (h, w, 3) uint8 as JPEG; its format is image_transport's."""
    stream = io.BytesIO()
    Image.fromarray(colour).save(stream, "JPEG", quality=JPEG_QUALITY)
    message.header, message.format = header, "rgb8; jpeg compressed bgr8"
    message.data = array("B", stream.getvalue())
    return message


def fill_camera_info(message: Any, header: Any, view: View, T_scan_cloud: np.ndarray) -> Any:
    """Fill a CameraInfo for a panorama on a cylinder.

    ROS has no such projection. Therefore distortion_model is "cylindrical", which no program of ROS knows, and K and P
    stay zero, which ROS defines as not calibrated: whatever assumes a pinhole camera refuses it. d holds
    (fu, cu, fv, cv, x, y, z), r the rotation R (3, 3) from the cloud's frame to one with x forward, y left, z up, which
    is the identity unless the cloud has other axes or is tilted. Pixel (u, v), whose middle has whole numbers, looks
    from the point (x, y, z) of the cloud's frame in metres along transpose(R) (cos a, sin a, t), where

        a = (cu - u) / fu   in radians, counter-clockwise from ahead;      t = (cv - v) / fv.
    """
    fu, fv = view.focal_px, view.rows / (view.up - view.down)
    message.header = header
    message.height, message.width = view.rows, view.columns
    message.distortion_model = CYLINDRICAL
    cu, cv = fu * np.radians(view.left) - 0.5, fv * view.up - 0.5
    R = T_scan_cloud[:3, :3]
    origin = in_cloud(np.array([view.origin]), T_scan_cloud)[0]
    message.d = [float(value) for value in (fu, cu, fv, cv, *origin)]
    message.k, message.r, message.p = [0.0] * 9, [float(value) for value in R.ravel()], [0.0] * 12
    return message


def fill_pinhole_info(message: Any, header: Any, calibration: Calibration) -> Any:
    """Fill a CameraInfo for a perspective camera without distortion."""
    message.header = header
    message.width, message.height = calibration.size
    message.distortion_model, message.d = "plumb_bob", [0.0] * 5
    K = calibration.K
    message.k, message.r = [float(value) for value in K.ravel()], [float(value) for value in np.eye(3).ravel()]
    message.p = [float(value) for value in np.c_[K, np.zeros(3)].ravel()]
    return message


def fill_points(message: Any, new_field: Callable[[], Any], header: Any, points: np.ndarray) -> Any:
    """Fill a PointCloud2 with a structured array of POINT; rgb is packed in the bits of a float, as PCL has it."""
    message.header, message.height, message.width = header, 1, len(points)
    message.fields = []
    for name, kind in POINT:
        field = new_field()
        field.name, field.offset, field.count = name, points.dtype.fields[name][1], 1
        field.datatype = UINT16 if kind == "<u2" else FLOAT32
        message.fields.append(field)
    message.is_bigendian, message.point_step = False, points.dtype.itemsize
    message.row_step = points.dtype.itemsize * len(points)
    message.data = array("B", points.tobytes())
    message.is_dense = bool(all(np.isfinite(points[axis]).all() for axis in "xyz"))
    return message


def points_of(xyz: np.ndarray, intensity: np.ndarray, colour: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Return a structured array of POINT: places (N, 3), remission in 0 to 1, RGB (N, 3) uint8, raw labels."""
    points = np.empty(len(xyz), dtype=POINT)
    for number, axis in enumerate("xyz"):
        points[axis] = xyz[:, number]
    red, green, blue = colour.T.astype(np.uint32)
    points["intensity"], points["rgb"], points["label"] = intensity, red << 16 | green << 8 | blue, label
    return points


def in_cloud(xyz: np.ndarray, T_scan_cloud: np.ndarray) -> np.ndarray:
    """Return places (N, 3) of a scan's frame in its cloud's own frame."""
    return (xyz - T_scan_cloud[:3, 3]) @ T_scan_cloud[:3, :3]
