"""Names that users of the node meet: its topics and its parameters."""

from __future__ import annotations

TOPICS = {  # all below panorama/, with the types of sensor_msgs
    "image": "Image",
    "image/compressed": "CompressedImage",
    "camera_info": "CameraInfo",
    "labels": "Image",
    "classes": "Image",
    "depth": "Image",
    "points": "PointCloud2",
}
PARAMETERS = {  # name -> default and meaning; all are strings
    "weights": ("best", "a released family, or a folder or file of weights"),
    "engine": ("auto", "auto, torch, compile, onnx or openvino"),
    "device": ("auto", "auto, cpu or cuda"),
    "look": ("", "a look of the painter; empty: its own"),
    "elevation": ("", "LOW,HIGH in degrees, or auto for what the sensor sees and more; empty: the usual rows"),
    "forward": ("", "the cloud's forward axis: x, y, -x, -y; empty: found out"),
    "remission": ("", "full remission: 1, 255, 65535; or none, if unusable; empty: found out"),
    "sensor_height": ("", "metres of the sensor above the ground; empty: found out"),
    "cameras": (
        "",
        "topics of images to keep the pixels of, joined by commas; each needs a camera_info beside it, and tf",
    ),
    "fixed_frame": ("", "a frame of tf that does not move (odom, map): smooths over time, moves cameras to the scan"),
    "calib": ("", "a KITTI calib.txt: the view of its camera is published instead of the panorama"),
}
