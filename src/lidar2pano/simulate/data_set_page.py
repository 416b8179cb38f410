"""The page of a simulated data set (README.md): the header that hubs read, and the content of its folders."""

from __future__ import annotations

from pathlib import Path

from lidar2pano.formats.image_files import write_text
from lidar2pano.formats.json_files import front_matter
from lidar2pano.simulate.settings import FORMAT, WorldSettings

PAGE = "README.md"
CONTENT = """
Drives through streets that a program made from a seed: no place, person or vehicle in them exists. The layout is
SemanticKITTI's, so that its readers read it; `splits.json` names the frames of `train`, `val` and `all`.

| in each of `sequences/*/` | content |
| --- | --- |
| `velodyne/` | scans of a rotating LiDAR: x, y, z (forward, left, up; metres), remission; float32 |
| `labels/` | SemanticKITTI's raw ids (low 16 bits) and instances (high 16 bits) of the points, uint32 |
| `calib.txt`, `poses.txt`, `times.txt` | KITTI's files |
"""
FOLDERS = {
    "camera": "| `image_2/`, `camera_labels/` | the camera's image, and its classes as Cityscapes' train ids |\n",
    "panorama": "| `pano/`, `pano_labels/`, `pano_depth/`, `pano_openings/` | all around: RGB, ids of common-15, depth"
    " (metres x 256), windows and doors |\n",
}


def data_set_page(settings: WorldSettings) -> str:
    """Return the page of a world: Markdown with a YAML header, a function of its settings alone."""
    header = {
        "license": "apache-2.0",
        "pretty_name": f"lidar2pano world {settings.seed}",
        "tags": ["lidar", "point-cloud", "panorama", "autonomous-driving", "synthetic", "lidar2pano"],
        "task_categories": ["image-segmentation", "depth-estimation", "image-to-image"],
        "annotations_creators": ["machine-generated"],
        "source_datasets": ["original"],
    }
    values = {key: value for key, value in settings.as_dict().items() if key not in ("form", "save", "views")}
    options = " ".join(f"--{key} {value}" for key, value in values.items() if value != "")
    if settings.save:
        options += "".join(f" --view {view}" for view in settings.views)
    options += f" --save {','.join(settings.save) or 'scans'}"
    made = f"Made by `lidar2pano world OUT {options}` (form {FORMAT}): the same seed gives the same bytes.\n"
    folders = "".join(FOLDERS[name] for name in settings.save)
    return f"{front_matter(header)}\n# A simulated world\n{CONTENT}{folders}\n{made}"


def write_page(out: Path, settings: WorldSettings) -> None:
    """Write the page of a world into its folder; one that is there stays, since it may be someone's own."""
    if not (out / PAGE).exists():
        text = data_set_page(settings)
        write_text(out / PAGE, text)
