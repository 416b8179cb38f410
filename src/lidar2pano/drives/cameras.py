"""The cameras of a scan: named by the user, beside its file in the layouts of data sets, or in its recording."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidar2pano.calibration import Calibration, LensCalibration, read_calib
from lidar2pano.data.camera_files import calibration_of, read_camera_calibration
from lidar2pano.data.surround import SurroundFrame
from lidar2pano.drives.camera_choice import RAW, SISTERS, CameraOptions, NamedCamera
from lidar2pano.drives.drive_motion import oxts_motion
from lidar2pano.drives.folders import UNIT_S, times
from lidar2pano.errors import InputError
from lidar2pano.formats.file_contents import stem_of
from lidar2pano.formats.image_files import image_size, read_image
from lidar2pano.geometry.motion import SensorMotion
from lidar2pano.geometry.stitching import Camera
from lidar2pano.recordings.reading_process import confined_images
from lidar2pano.recordings.recorded_images import RecordedImage
from lidar2pano.views import VIEWS

IMAGES = (".png", ".jpg", ".jpeg", ".webp")
MOST_TRIED = 8  # images of a folder: some may be damaged
STAMP = re.compile(r"(?:^|\D)(\d{16}|\d{18,19})$")  # at the end of a file's stem


class ScanCameras(NamedTuple):
    """Readable cameras of a scan, in its frame; a sentence on each of the others; the only camera's calibration."""

    cameras: tuple[Camera, ...]
    doubts: tuple[str, ...]
    viewpoint: Calibration | LensCalibration | None


class CameraSource(NamedTuple):
    """A camera: its name, and a function to read it, in the coordinates of the scan's file."""

    name: str
    load: Callable[[], Camera]


def cameras_of(scan_file: Path, stem: str, options: CameraOptions, T_scan_file: np.ndarray) -> ScanCameras:
    """Read the cameras of a scan; InputError for a wrong number of masks.

    stem         of the scan's images in a folder of --camera.
    T_scan_file  (4, 4): from the coordinates of the scan's file, and of calibrations, to the scan's.
    """
    sources = [_named(camera, scan_file, stem) for camera in options.named]
    if not sources and options.auto:
        try:
            sources = list(found_beside(scan_file.resolve()))
        except InputError as error:
            return ScanCameras((), (f"cameras are left out: {error}",), None)
    motion, stamp_s = None, _stamp(scan_file)
    if sources and stamp_s is not None:
        try:
            motion = oxts_motion(scan_file.resolve())
        except InputError as error:
            cameras = read_sources(sources, options, T_scan_file)
            return cameras._replace(doubts=(*cameras.doubts, f"motion between images and scan stays in: {error}"))
    if motion is not None and stamp_s is not None:
        sources = [source._replace(load=partial(_carried, source.load, motion, stamp_s)) for source in sources]
    return read_sources(sources, options, T_scan_file)


def _carried(load: Callable[[], Camera], motion: SensorMotion, stamp_s: float) -> Camera:
    """Return a camera as it stood beside the scan when its image was taken, if the poses reach so far."""
    camera = load()
    image_pose, scan_pose = (motion.pose(moment_s) for moment_s in (stamp_s + (camera.time_s or 0.0), stamp_s))
    if image_pose is None or scan_pose is None:
        return camera
    T = camera.calibration.T_camera_lidar @ np.linalg.inv(image_pose) @ scan_pose
    return replace(camera, calibration=replace(camera.calibration, T_camera_lidar=T))


class RecordingCameras:
    """The cameras of a recording, scan after scan; InputError for topics without images."""

    def __init__(self, path: Path, options: CameraOptions) -> None:
        self._images, self._options = confined_images(path, options.topics), options
        self._topics, self.close = self._images.topics(), self._images.close

    def __bool__(self) -> bool:
        """Return whether it has any."""
        return bool(self._topics)

    def of(self, stamp_s: float, frame: str, T_scan_cloud: np.ndarray) -> ScanCameras:
        """Read the cameras of a scan at a time, whose cloud's frame is `frame`; InputError for damage."""
        images = self._images.at(stamp_s, frame)
        sources = [CameraSource(image.topic, partial(_of_image, image)) for image in images]
        cameras = read_sources(sources, self._options, T_scan_cloud)
        moving = [image.topic for image in images if not image.error and not image.moved]
        if not moving:
            return cameras
        motion = (
            f"camera {', '.join(moving)}: the motion between its images and the scans is not known (neither tf nor"
            f" odometry moves {frame!r}) and stays in"
        )
        return cameras._replace(doubts=(*cameras.doubts, motion))


def _of_image(image: RecordedImage) -> Camera:
    """Return the camera of an image; InputError for its error, or a calibration of no use."""
    if image.image is None or image.T_camera_lidar is None:
        raise InputError(image.error)
    (height, width), topic = image.image.shape[:2], Path(image.topic)
    info = Path(f"the CameraInfo of {image.topic}")
    calibration = calibration_of(info, image.intrinsics or {}, topic, (width, height), image.T_camera_lidar)
    return Camera(image.image, calibration, time_s=image.time_s)


def read_sources(sources: Sequence[CameraSource], options: CameraOptions, T_scan_file: np.ndarray) -> ScanCameras:
    """Read cameras with their masks; InputError for a wrong number of masks.

    T_scan_file  (4, 4): from the coordinates of their calibrations to the scan's.
    """
    if len(options.masks) > 1 and len(options.masks) != len(sources):
        raise InputError(
            f"--mask: {len(options.masks)} masks for {len(sources)} cameras; name one for all, or one each"
        )
    masks = options.masks * len(sources) if len(options.masks) == 1 else options.masks or (None,) * len(sources)
    cameras: list[Camera] = []
    faults: list[str] = []
    for source, mask in zip(sources, masks, strict=True):
        try:
            camera = source.load()
            cameras.append(_placed(masked(camera, mask) if mask else camera, source.name, T_scan_file))
        except InputError as error:
            faults.append(f"camera {source.name} is left out: {error}")
    viewpoint = cameras[0].calibration if len(cameras) == len(sources) == 1 else None
    return ScanCameras(tuple(cameras), tuple(faults), viewpoint)


def masked(camera: Camera, mask: Path) -> Camera:
    """Return the camera with the vehicle where a mask image is not black; InputError if it is of another size."""
    (columns, rows), (width, height) = image_size(mask), camera.calibration.size
    if (columns, rows) != (width, height):
        raise InputError(f"{mask}: is {columns}x{rows}, the image {width}x{height}; draw the mask on the image")
    pixels = read_image(mask, "RGB").any(axis=2)
    return replace(camera, ego_mask=pixels if camera.ego_mask is None else pixels | camera.ego_mask)


def _placed(camera: Camera, name: str, T_scan_file: np.ndarray) -> Camera:
    calibration = camera.calibration
    T_camera_scan = calibration.T_camera_lidar @ np.linalg.inv(T_scan_file)
    return replace(camera, calibration=replace(calibration, T_camera_lidar=T_camera_scan), name=name)


def _named(camera: NamedCamera, scan_file: Path, stem: str) -> CameraSource:
    name = camera.image.name if camera.image.is_dir() else f"{camera.image.parent.name}/{camera.image.name}"
    return CameraSource(name.removeprefix("/"), partial(_read_named, camera, scan_file, stem))


def _read_named(camera: NamedCamera, scan_file: Path, stem: str) -> Camera:
    image = camera.image
    if image.is_dir():
        image = next(images_of(image, stem), image / f"{stem}.png")
    calibration = read_camera_calibration(camera.calibration, image, image_size(image), camera.pose)
    return _read(scan_file, image, calibration)


def _read(scan_file: Path, image: Path, calibration: Calibration | LensCalibration) -> Camera:
    return Camera(read_image(image, "RGB"), calibration, time_s=seconds_after(scan_file, image))


def check_named(camera: NamedCamera) -> None:
    """Read a named camera's calibration, for one of the first images of a folder; InputError if that is impossible."""
    images = [camera.image]
    if camera.image.is_dir():
        images = sorted(path for path in camera.image.iterdir() if path.suffix.lower() in IMAGES)[:MOST_TRIED]
    error = InputError(f"{camera.image}: holds no image ({', '.join(IMAGES)}); name another folder")
    for image in images:
        try:
            read_camera_calibration(camera.calibration, image, image_size(image), camera.pose)
        except InputError as fault:
            error = fault
        else:
            return
    raise error


def images_of(folder: Path, stem: str) -> Iterator[Path]:
    """Return the images of a folder with this stem."""
    return (path for ending in IMAGES if (path := folder / f"{stem}{ending}").is_file())


def seconds_after(scan_file: Path, image: Path) -> float | None:
    """Return when an image was taken, seconds after the scan; None if a time is unknown.

    Times are the numbers of microseconds or nanoseconds at the ends of names, or in lists of times beside the files.
    """
    stamps = [_stamp(path) for path in (scan_file, image)]
    return None if stamps[0] is None or stamps[1] is None else stamps[1] - stamps[0]


def _stamp(path: Path) -> float | None:
    if match := STAMP.search(stem_of(path)):
        return int(match[1]) * UNIT_S[len(match[1])]
    try:
        stamps_s = times([path])
    except InputError:
        return None
    return stamps_s[0] if stamps_s else None


def found_beside(scan_file: Path) -> Iterator[CameraSource]:
    """Yield the cameras of a scan file in a layout of KITTI, PandaSet or nuScenes; or none."""
    folder, stem = scan_file.parent, stem_of(scan_file)
    if folder.name == "velodyne" and (folder.parent / "calib" / f"{stem}.json").is_file():
        from lidar2pano.data import pandaset

        frame = pandaset.PandasetFrame(folder.parents[2], VIEWS["panorama"], f"{folder.parent.name}/{stem}")
        yield from _of_frame(scan_file, frame)
    elif folder.name == "velodyne":
        yield from _beside_velodyne(scan_file)
    elif folder.parent.name == "velodyne" or folder.parts[-2:] == ("velodyne_points", "data"):  # tracking; raw
        root = folder.parents[1]
        calibration = root / "calib" / f"{folder.name}.txt" if folder.parent.name == "velodyne" else root
        for number, name in enumerate(RAW, 2):
            for image in images_of(root / name / folder.name, stem):
                yield CameraSource(name, partial(_read_kitti, scan_file, image, calibration, number))
    else:
        from lidar2pano.data import nuscenes

        if frame := nuscenes.frame_of(scan_file, VIEWS["panorama"]):
            yield from _of_frame(scan_file, frame)


def _beside_velodyne(scan_file: Path) -> Iterator[CameraSource]:
    """Yield KITTI odometry's cameras; and those of sequences beside it with links to the same scan."""
    sequence = scan_file.parents[1]
    family = sequence.name.rpartition("-")[0]
    sisters = sorted(sequence.parent.glob(f"{family}-*")) if family else []
    for folder in [sequence, *(sister for sister in sisters if sister != sequence)]:
        linked_scan = folder / "velodyne" / scan_file.name
        if folder != sequence and not (linked_scan.is_file() and linked_scan.samefile(scan_file)):
            continue
        own = folder / "calib" / f"{stem_of(scan_file)}.txt"  # of the object benchmark
        for number, name in enumerate(SISTERS, 2):
            for image in images_of(folder / name, stem_of(scan_file)):
                source = f"{folder.name}/{name}".removeprefix(f"{sequence.name}/")
                calibration = own if own.is_file() else folder
                yield CameraSource(source, partial(_read_kitti, scan_file, image, calibration, number))


def _read_kitti(scan_file: Path, image: Path, calibration: Path, number: int) -> Camera:
    return _read(scan_file, image, read_calib(calibration, image_size(image), number))


def _of_frame(scan_file: Path, frame: SurroundFrame) -> Iterator[CameraSource]:
    for name in frame.camera_names:
        yield CameraSource(name, partial(_read_of_frame, scan_file, frame, name))


def _read_of_frame(scan_file: Path, frame: SurroundFrame, name: str) -> Camera:
    camera, time_s = frame.camera(name), seconds_after(scan_file, frame.camera_file(name))
    T_camera_file = camera.calibration.T_camera_lidar @ frame.T_sensor_file
    return replace(camera, calibration=replace(camera.calibration, T_camera_lidar=T_camera_file), time_s=time_s)
