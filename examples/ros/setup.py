"""Installs the package for colcon (ament_python)."""

from setuptools import setup

NAME = "lidar2pano_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/panorama.launch.py"]),
        (f"share/{NAME}/foxglove", ["foxglove/panorama.json"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="The lidar2pano maintainers",
    description="PointCloud2 in, 360-degree panoramas, their classes and depths, and coloured points out.",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"panorama = {NAME}.node:main"]},
)
