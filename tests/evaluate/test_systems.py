"""Systems under evaluation: which system weights are, and that its inputs are those of its training task."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from installed_families import install_only
from lidar2pano.calibration import Calibration, read_calib
from lidar2pano.data.frames import Frame
from lidar2pano.data.layouts import frames
from lidar2pano.errors import InputError
from lidar2pano.evaluate import SystemInput, system
from lidar2pano.evaluate.panorama_system import PanoramaSystem
from lidar2pano.evaluate.systems import (
    CameraPainter,
    CameraRenderer,
    CameraTranslator,
    Oracle,
    training_scale,
)
from lidar2pano.geometry.camera import at_camera, panorama_in_camera
from lidar2pano.geometry.projection import Normalisation, project
from lidar2pano.hardware import Timer
from lidar2pano.labels import COMMON15, TABLES
from lidar2pano.memory import Memory
from lidar2pano.models.card import Card, read_card, save
from lidar2pano.pipeline import load
from lidar2pano.scan import drop_points
from lidar2pano.scene.depth import denser
from lidar2pano.train.colour import ColourTask
from lidar2pano.train.front import FrontDepthTranslation, FrontTask
from lidar2pano.train.tasks import build_task
from lidar2pano.views import VIEWS
from miniature import SIZE as CAMERA
from miniature import write_data_set
from random_weights import (
    CALIB,
    FRONT_VIEW,
    spread_norms,
    street,
    write_family,
    write_front,
    write_scan,
    write_segmenter,
    write_weights,
)
from small_recipes import small

ROAD, CAR, PERSON = map(COMMON15.id_of, ("road", "car", "person"))
RASTER = f"[{CAMERA[1]},{CAMERA[0]}]"  # a network whose images have the camera's own size: nothing is resized
VIDEO = {"channels": 16, "widths": [8], "downsamplings": 2, "blocks": [1, 1], "foreground": []}
FRONT_STAGES = ["project", "segment", "clean_up", "translate", "camera"]


pytestmark = pytest.mark.usefixtures("small_view")


@pytest.fixture(autouse=True)
def _no_family(monkeypatch, tmp_path):
    install_only(monkeypatch, tmp_path / "none")


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return write_data_set(tmp_path_factory.mktemp("data"))


@pytest.fixture
def frame(root) -> Frame:
    return frames(root, "val")[0]


@pytest.fixture
def kitti(tmp_path) -> Calibration:
    """KITTI's camera."""
    write_scan(tmp_path / "sequences" / "00" / "velodyne" / "000000.bin")
    (tmp_path / "sequences" / "00" / "calib.txt").write_text(CALIB)
    return read_calib(tmp_path / "sequences" / "00" / "calib.txt", (1241, 376))


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    """A small vid2vid that was trained on images of half KITTI's size."""
    views = {"panorama": VIEWS["panorama"].scaled(0.5).as_dict()}
    return write_weights(tmp_path_factory.mktemp("video"), "painter", "vid2vid", VIDEO, views=views)


def at(frame: Frame, **more: object) -> SystemInput:
    return SystemInput(scan=frame.scan, calibration=frame.calibration, **more)


def released(recipe_name: str, root: Path, folder: Path, *further: str):
    """A task with untrained networks, and the folder in which its released network lies as `train` writes it."""
    recipe = small(recipe_name, *further)
    task = build_task(recipe, root)
    (role,) = task.released
    network = spread_norms(task.networks[role]).eval()
    if isinstance(task, FrontTask) and hasattr(network, "logits"):
        balance(task, network)
    card = Card(network=recipe.networks[role].model, settings=dict(recipe.networks[role].settings), **task.card(role))
    save(folder / f"{role}.safetensors", network, card, dtype=torch.float32)
    return task, folder


def balance(task: FrontTask, network: nn.Module) -> None:
    """Let an untrained network name several classes: its scores have the same mean."""
    means: list[Tensor] = []
    hook = network.logits.register_forward_hook(lambda _, __, out: means.append(out.mean((0, 2, 3))))
    task.predict(task.validation[0])
    hook.remove()
    network.logits.bias.data -= means[0]


# --- the paper's systems predict as their tasks do ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("titan-mini", "translator"),
        ("titan-no-lovasz-mini", "translator"),
        ("titan-no-range-mini", "translator"),
        ("titan-next-mini", "translator"),
        ("pix2pix-segments-mini", "translator"),
    ],
)
def test_a_translator_answers_as_its_task_predicts(name, role, root, frame, tmp_path):
    segmenter = write_segmenter(tmp_path)
    task, folder = released(
        name, root, tmp_path, f"networks.{role}.settings.size={RASTER}", f"options.segmenter={segmenter}"
    )
    one = system(folder, device="cpu")
    assert isinstance(one, CameraTranslator) and not one.uses_ground_truth and isinstance(task, FrontTask)
    memory, prediction = one.predict(at(frame))
    sample = task.validation[0]
    wanted = TABLES["common-14", "common-15"][task.predict(sample).numpy()]
    assert memory is None and prediction.image is None and prediction.panorama is None
    assert np.array_equal(prediction.camera_labels, wanted) and len(np.unique(wanted)) > 1
    assert np.array_equal(prediction.point_labels, task.validation.pair(0).scan.label)
    if isinstance(task, FrontDepthTranslation):
        assert np.allclose(prediction.depth_m, task.predict_both(sample)[1], atol=1e-4)
    else:
        assert prediction.depth_m is None
    assert list(prediction.milliseconds) == FRONT_STAGES


@pytest.mark.parametrize(
    ("name", "further"),
    [
        ("titan-no-segments-mini", f"networks.renderer.settings.size={RASTER}"),
        ("pix2pix-rgb-mini", f"networks.renderer.settings.size={RASTER}"),
        ("scunet-mini", f"options.size={RASTER}"),
    ],
)
def test_a_renderer_paints_as_its_task_does(name, further, root, frame, tmp_path):
    task, folder = released(name, root, tmp_path, further)
    one = system(folder, device="cpu")
    assert isinstance(one, CameraRenderer) and not one.uses_ground_truth and isinstance(task, ColourTask)
    _, prediction = one.predict(at(frame))
    wanted = (task.render(0)[0].movedim(0, 2).numpy() + 1) * 127.5
    assert prediction.image is not None and np.abs(prediction.image - wanted).max() <= 0.501
    assert wanted.std() > 0.1
    assert (prediction.point_labels, prediction.camera_labels, prediction.panorama) == (None, None, None)
    assert one.predict(at(frame, colours=False))[1].image is None


def test_sc_unet_with_range_on_the_raster_of_its_card(root, frame, tmp_path):
    card = {"views": {"camera": {"rows": 24, "columns": 80}}}
    path = write_weights(tmp_path, "renderer", "scunet", {"inputs": 2, "widths": [4, 8, 8]}, **card)
    one = system(path, device="cpu")
    assert isinstance(one, CameraRenderer)
    inputs: list[Tensor] = []

    def render(x: Tensor) -> Tensor:
        inputs.append(x)
        return torch.zeros(1, 3, *x.shape[2:])

    _, prediction = replace(one, renderer=_Function(render)).predict(at(frame))
    from lidar2pano.geometry.camera import project_to_camera
    from lidar2pano.train.colour import camera_inputs

    assert frame.calibration is not None and frame.calibration.size == CAMERA
    wanted = camera_inputs(project_to_camera(frame.scan, frame.calibration, (24, 80))[None], 2)
    assert torch.equal(inputs[0], wanted) and (wanted[0, 1] > 0).any()
    assert (
        prediction.image is not None
        and prediction.image.shape == (CAMERA[1], CAMERA[0], 3)
        and (prediction.image == 128).all()
    )


class _Function(nn.Module):
    def __init__(self, function) -> None:
        super().__init__()
        self.function = function

    def forward(self, *inputs: Tensor):
        return self.function(*inputs)


class Sides(nn.Module):
    """A translator: `left` in the left half of its image, `right` in the right half; it keeps its inputs."""

    def __init__(self, left: int, right: int, size: tuple[int, int] | None = None) -> None:
        super().__init__()
        self.left, self.right, self.size = left, right, size

    def forward(self, image, condition):
        self.inputs = image, condition
        height, width = self.size or image.shape[2:]
        logits = torch.zeros(1, 15 if self.size else 16, height, width)
        logits[:, self.left, :, : width // 2], logits[:, self.right, :, width // 2 :] = 20, 20
        return logits if self.size else (logits, torch.full((1, height, width), 7.0))


def test_the_front_view_is_resized_to_the_cameras_image(front_weights, frame):
    plain = system(front_weights, device="cpu")
    assert isinstance(plain, CameraTranslator)
    inputs = SystemInput(scan=street(), calibration=replace(frame.calibration, size=(320, 96)))
    prediction = replace(plain, translator=(sides := Sides(CAR, ROAD, size=(2, 4)))).predict(inputs)[1]
    assert prediction.camera_labels.shape == (96, 320) and prediction.point_labels.shape == (len(street()),)
    assert (prediction.camera_labels[:, :159] == CAR).all() and (prediction.camera_labels[:, 161:] == ROAD).all()
    image, condition = sides.inputs
    front = project(street(), FRONT_VIEW)
    assert torch.equal(image[0], Normalisation()(front))
    assert torch.equal(condition[0].argmax(0), front.spread(torch.from_numpy(prediction.point_labels)))


# --- ours ------------------------------------------------------------------------------------------------------------


def test_a_panorama_is_resampled_to_the_camera(random_weights, kitti):
    plain = system(random_weights, device="cpu")
    assert isinstance(plain, PanoramaSystem)
    one = replace(plain, pipeline=replace(plain.pipeline, translator=(sides := Sides(PERSON, ROAD))))
    _, prediction = one.predict(SystemInput(scan=street(), calibration=kitti, colours=False))
    whole, _, _ = denser(street(), one.pipeline.segmenter.project(street()))
    assert torch.equal(sides.inputs[0][0], project(whole, at_camera(one.pipeline.view, kitti)).channels)
    assert prediction.camera_labels.shape == (376, 1241) and prediction.point_labels.shape == (len(street()),)
    assert (
        prediction.camera_labels[:5, 590:620] == 0
    ).all()  # ahead, the panorama reaches up to tan 0.24: row 180 - 0.24 * 718.9
    assert (prediction.camera_labels[16:, :600] == PERSON).all() and (
        prediction.camera_labels[16:, 615:] == ROAD
    ).all()  # ahead is column 607
    assert (prediction.depth_m[16:] > 0).all() and prediction.depth_m[0, 600] == 0
    assert prediction.image is None and prediction.panorama is None
    assert list(prediction.milliseconds) == FRONT_STAGES


def test_a_taller_panorama_fills_the_cameras_image(random_weights, front_weights, kitti):
    for elevation in ("-16,20", "auto"):
        one = system(random_weights, device="cpu", elevation=elevation)
        memory, prediction = one.predict(SystemInput(scan=street(), calibration=kitti, colours=False))
        assert prediction.camera_labels.shape == (376, 1241)
        filled = (prediction.depth_m[0] > 0).all()
        assert filled == (elevation != "auto"), "the street's sensor sees 2 degrees, so auto goes on to 12"
        assert memory["camera"].view == (None if filled else one.pipeline.fitted(street(), Memory()).at(kitti).view)
    with pytest.raises(InputError, match="elevation 'auto' is of panoramas"):
        system(front_weights, device="cpu", elevation="auto")
    with pytest.raises(InputError, match="elevation"):
        system(random_weights, device="cpu", elevation="9,high")


def test_colours_are_those_of_the_pipeline(random_weights, kitti):
    one = system(random_weights, device="cpu")
    inputs = SystemInput(scan=street(), calibration=kitti, origin=kitti.centre)
    memory, prediction = one.predict(inputs)
    wanted = load(random_weights, "cpu").at(kitti)(street())
    assert prediction.panorama is not None and prediction.painted and prediction.panorama.view == wanted.view
    assert np.array_equal(prediction.panorama.colour, wanted.colour)
    assert np.array_equal(prediction.panorama.depth_m, wanted.depth_m)
    assert np.array_equal(prediction.image, wanted.to_camera(kitti).colour)
    assert list(prediction.milliseconds) == [*FRONT_STAGES[:-1], "paint", "finish", "camera"]
    assert one.predict(inputs, memory)[1].panorama.frame == 1  # the stream goes on
    assert one.predict(inputs)[1].panorama.frame == 0


def test_steady_systems_get_the_poses(random_weights, front_weights, kitti):
    plain, steady = (system(f"{random_weights}{more}", device="cpu") for more in ("", "+steady"))
    assert isinstance(steady, PanoramaSystem) and steady.info.name == f"{random_weights}+steady" and not plain.steady
    recording = [(street(), np.eye(4)), (drop_points(street(), np.random.default_rng(1), 0.3), np.eye(4))]
    prediction = {}
    for one in (plain, steady):
        memory = None
        for scan, pose in recording:
            memory, prediction[one] = one.predict(SystemInput(scan=scan, origin=kitti.centre, pose=pose), memory)
    wanted = list(load(random_weights, "cpu").at(kitti).stream([scan for scan, _ in recording], [np.eye(4)] * 2))[1]
    assert np.array_equal(prediction[steady].panorama.colour, wanted.colour)
    assert not np.array_equal(prediction[plain].panorama.colour, wanted.colour)
    with pytest.raises(InputError, match="leave \\+steady out"):
        system(f"{front_weights}+steady", device="cpu")


def test_a_steady_system_is_scored_on_the_fused_scene_in_the_camera_too(random_weights, kitti):
    plain, steady = (system(f"{random_weights}{suffix}", device="cpu") for suffix in ("", "+steady"))
    scans = [street(), drop_points(street(), np.random.default_rng(1), 0.3)]
    for colours in (True, False):
        prediction = {}
        for one in (plain, steady):
            memory = None
            for scan in scans:
                inputs = SystemInput(scan=scan, calibration=kitti, pose=np.eye(4), colours=colours)
                memory, prediction[one] = one.predict(inputs, memory)
        pipeline, timer, memory = steady.pipeline.at(kitti), Timer(torch.device("cpu")), Memory()
        for scan in scans:
            memory, scene = pipeline.remember(memory, pipeline.translate(scan, timer), np.eye(4), timer)
        lookup = panorama_in_camera(scene.view, kitti)
        ids = lookup.linear(scene.probabilities[0].clamp(min=1e-20).log()).max(0).indices
        assert np.array_equal(prediction[steady].camera_labels, ids.numpy())
        assert np.array_equal(prediction[steady].depth_m, lookup.linear(scene.depth_m[0]).numpy())
        for name in ("camera_labels", "depth_m"):
            assert not np.array_equal(getattr(prediction[plain], name), getattr(prediction[steady], name)), name


def test_a_panorama_around_another_point_is_a_run_of_its_own(random_weights, kitti):
    one = system(random_weights, device="cpu")
    _, apart = one.predict(SystemInput(scan=street(), calibration=kitti, origin=(0.0, 0.0, 0.5)))
    _, camera = one.predict(SystemInput(scan=street(), calibration=kitti, origin=kitti.centre))
    _, alone = one.predict(SystemInput(scan=street(), origin=(0.0, 0.0, 0.5)))
    assert apart.panorama.view.origin == (0.0, 0.0, 0.5) == alone.panorama.view.origin
    assert np.array_equal(apart.panorama.colour, alone.panorama.colour)
    assert not np.array_equal(apart.panorama.colour, camera.panorama.colour)
    assert np.array_equal(apart.image, camera.image) and np.array_equal(apart.camera_labels, camera.camera_labels)
    assert alone.camera_labels is None and alone.image is None


def test_without_a_painter_there_are_no_colours(tmp_path, kitti):
    (write_family(tmp_path / "all") / "painter.safetensors").unlink()
    one = system(tmp_path / "all", device="cpu")
    _, prediction = one.predict(SystemInput(scan=street(), calibration=kitti, origin=kitti.centre))
    assert prediction.image is None and not prediction.painted
    assert prediction.panorama is not None and len(np.unique(prediction.panorama.segments)) > 1


def test_points_alone(random_weights, front_weights):
    for weights in (random_weights, front_weights):
        one = system(weights, device="cpu")
        _, prediction = one.predict(SystemInput(scan=street()))
        assert prediction.point_labels is not None and prediction.point_labels.shape == (len(street()),)
        assert prediction.camera_labels is None and prediction.panorama is None and not prediction.milliseconds


class Stripes(nn.Module):
    """A segmenter whose classes change with every few metres of range."""

    def forward(self, x):
        return nn.functional.one_hot((x[:, 0].abs() * 3).long() % 20, 20).movedim(-1, 1).float()


def test_points_have_the_same_labels_whatever_else_is_requested(random_weights, front_weights, kitti):
    scan = street()
    near = replace(scan, xyz=np.where(np.arange(len(scan))[:, None] % 4, scan.xyz, scan.xyz / 50))
    panoramas, front = system(random_weights, device="cpu"), system(front_weights, device="cpu")
    striped = replace(front.segmenter, network=Stripes())
    for one in (
        replace(panoramas, pipeline=replace(panoramas.pipeline, segmenter=striped)),
        replace(front, segmenter=striped),
    ):
        _, alone = one.predict(SystemInput(scan=near))
        _, beside = one.predict(SystemInput(scan=near, calibration=kitti))
        assert len(np.unique(alone.point_labels)) > 3
        np.testing.assert_array_equal(alone.point_labels, beside.point_labels)


def test_another_sensor(random_weights, front_weights):
    for weights in (random_weights, front_weights):
        one = system(weights, device="cpu", sensor="pandar64")
        segmenter = one.pipeline.segmenter if isinstance(one, PanoramaSystem) else one.segmenter
        assert segmenter.view == VIEWS["pandar64"]
    with pytest.raises(InputError, match="no sensor 'pandar'; did you mean 'pandar64'"):
        system(random_weights, device="cpu", sensor="pandar")


# --- chains ----------------------------------------------------------------------------------------------------------


def test_a_translator_and_a_video_painter(front_weights, video, frame):
    one = system(f"{front_weights}+{video}", device="cpu")
    assert one.info.name == f"{front_weights}+{video}"
    assert set(one.info.networks) == {"segmenter", "translator", "painter"}
    bare = system(front_weights, device="cpu")
    memory, first = one.predict(at(frame))
    assert np.array_equal(first.camera_labels, bare.predict(at(frame))[1].camera_labels)
    painter = CameraPainter.from_files(video, None, torch.device("cpu"))
    with torch.inference_mode():
        remembered, wanted = painter.paint(None, torch.from_numpy(first.camera_labels))
        second = painter.paint(remembered, torch.from_numpy(first.camera_labels))[1]
    assert np.array_equal(first.image, wanted) and first.image.shape == (CAMERA[1], CAMERA[0], 3)
    assert np.array_equal(one.predict(at(frame), memory)[1].image, second) and not np.array_equal(second, wanted)
    assert one.predict(at(frame, colours=False))[1].image is None
    assert system(f"{front_weights}+{video}", device="cpu").info == one.info


def test_images_are_painted_at_the_size_of_training(video):
    painter = CameraPainter.from_files(video, None, torch.device("cpu"))
    assert painter.scale == 0.5 and not painter.painter.closed
    prediction: list[Tensor] = []

    class Spy:
        def follow(self, past, ids):
            prediction.append(ids)
            return past, torch.linspace(-1, 1, ids.shape[1]).expand(3, *ids.shape)

    ids = torch.arange(8)[:, None].expand(8, 12).to(torch.uint8)
    _, colour = replace(painter, painter=Spy()).paint(None, ids)
    assert prediction[0].shape == (4, 6) and prediction[0][:, 0].tolist() in ([0, 2, 4, 6], [1, 3, 5, 7])
    assert colour.shape == (8, 12, 3) and colour[0, 0, 0] == 0 and colour[0, -1, 0] == 255
    assert (np.diff(colour[0, :, 0].astype(int)) >= 0).all()
    assert training_scale(Card(network="vid2vid")) == 1


def test_the_oracle_paints_the_ground_truth(video, frame):
    one = system(f"oracle+{video}", device="cpu")
    assert isinstance(one, Oracle) and one.uses_ground_truth and one.info.name == f"oracle+{video}"
    ids = np.zeros((CAMERA[1], CAMERA[0]), np.uint8)
    ids[:, 100:] = ROAD
    _, prediction = one.predict(at(frame, camera_labels=ids))
    with torch.inference_mode():
        wanted = one.painter.paint(None, torch.from_numpy(ids))[1]
    assert np.array_equal(prediction.image, wanted)
    assert prediction.camera_labels is None and prediction.point_labels is None
    assert one.predict(at(frame))[1].image is None  # the labels are unknown


def test_a_painter_takes_the_familys_place(random_weights, video, kitti, tmp_path):
    one = system(f"{random_weights}+{video}", device="cpu")
    assert isinstance(one, PanoramaSystem)
    assert one.info.networks["painter"]["network"] == "vid2vid"
    assert set(one.info.networks) == {"segmenter", "translator", "painter"}


def test_the_default_family_fills_what_a_run_lacks(random_weights, video, tmp_path, monkeypatch):
    install_only(monkeypatch, random_weights.parent)
    run = tmp_path / "run"
    write_front(run / "weights")
    (run / "weights" / "segmenter.safetensors").unlink()
    front = system(run, device="cpu")
    assert isinstance(front, CameraTranslator) and front.painter is None  # the family's paints panoramas
    assert front.info.files["segmenter"].parent == random_weights
    assert isinstance(system(random_weights.name, device="cpu"), PanoramaSystem)
    only = tmp_path / "translator.safetensors"
    only.write_bytes((random_weights / "translator.safetensors").read_bytes())
    assert set(system(only, device="cpu").info.files) == {"segmenter", "translator", "painter"}
    assert read_card(only).network == "titan-pano"


# --- what does not go together ---------------------------------------------------------------------------------------


def test_what_cannot_be_a_system(random_weights, front_weights, video, tmp_path):
    renderer = write_weights(tmp_path / "r", "renderer", "scunet", {"widths": [4, 8, 8]})
    sdnet = {"width": 4, "stem": 4, "blocks": 1, "modules": [1, 1, 1], "context": 8}
    eye = write_weights(tmp_path / "e", "camera", "sdnet", sdnet, labels="cityscapes")
    write_weights(tmp_path / "two", "a", "scunet", {"widths": [4, 8, 8]})
    write_weights(tmp_path / "two", "b", "scunet", {"widths": [4, 8, 8]})
    (tmp_path / "empty").mkdir()
    translator = random_weights / "translator.safetensors"
    for name, said in {
        str(translator): "translator.safetensors: no weights for the segmenter",
        f"{renderer}+{video}": "a renderer predicts colours by itself, so the painter has no place",
        f"{front_weights}+{random_weights / 'painter.safetensors'}": "a 'latent-painter' paints panoramas only",
        "oracle": "oracle: the ground-truth labels have to be painted",
        str(eye): "a 'sdnet' has no part in a system; evaluate takes it as --sdnet",
        str(tmp_path / "two"): "a.safetensors and b.safetensors are both a renderer; name one of them",
        str(tmp_path / "empty"): "holds no weights",
        "oracl": "no weights 'oracl': neither a released family nor a file",
    }.items():
        with pytest.raises(InputError) as caught:
            system(name, device="cpu")
        assert said in str(caught.value), name
    with pytest.raises(InputError, match="no device 'gpu'"):
        system(random_weights, device="gpu")


def test_a_plus_in_a_files_own_name(random_weights, tmp_path):
    folder = tmp_path / "a+b"
    folder.mkdir()
    for file in random_weights.glob("*.safetensors"):
        (folder / file.name).write_bytes(file.read_bytes())
    assert system(folder, device="cpu").info.name == str(folder)
