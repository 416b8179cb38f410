"""Systems under evaluation: which one weights are, and that each sees what its training task says it sees."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from lidar2pano.calibration import Calibration
from lidar2pano.data.augment import drop_points
from lidar2pano.data.sequences import Frame, frames
from lidar2pano.errors import InputError
from lidar2pano.evaluate import Question, system
from lidar2pano.evaluate.around import Around
from lidar2pano.evaluate.films import CameraPainter, learnt_scale
from lidar2pano.evaluate.front import Ceiling, Direct, Front
from lidar2pano.geometry.camera import at_camera
from lidar2pano.geometry.images import Normalisation
from lidar2pano.geometry.projection import project
from lidar2pano.labels import COMMON15, TABLES
from lidar2pano.models.card import Card, read_card, save
from lidar2pano.pipeline import load
from lidar2pano.train.direct import DirectColour
from lidar2pano.train.front import FrontTranslation
from lidar2pano.train.front_depth import FrontDepthTranslation
from lidar2pano.train.task import build_task
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

ROAD, CAR = COMMON15.id_of("road"), COMMON15.id_of("car")
RASTER = f"[{CAMERA[1]},{CAMERA[0]}]"  # a network that writes pictures of the camera's own size: nothing is resized
VIDEO = {"channels": 16, "widths": [8], "downsamplings": 2, "blocks": [1, 1], "foreground": []}
FRONT_STAGES = ["project", "segment", "clean_up", "translate", "camera"]


pytestmark = pytest.mark.usefixtures("small_view")


@pytest.fixture(autouse=True)
def _no_family(monkeypatch, tmp_path):
    monkeypatch.setattr("lidar2pano.models.families.RELEASED", tmp_path / "none")


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
    return Frame(folder=tmp_path / "sequences" / "00", stem="000000").calibration((1241, 376))


@pytest.fixture(scope="module")
def film(tmp_path_factory) -> Path:
    """A small vid2vid that learnt from pictures half KITTI's size."""
    views = {"panorama": VIEWS["panorama"].scaled(0.5).as_dict()}
    return write_weights(tmp_path_factory.mktemp("film"), "painter", "vid2vid", VIDEO, views=views)


def at(frame: Frame, **more: object) -> Question:
    return Question(scan=replace(frame.scan(), name=frame.name), calibration=frame.calibration(CAMERA), **more)


def released(recipe_name: str, root: Path, folder: Path, *further: str):
    """A task with untrained networks, and the folder in which its released network lies as `train` writes it."""
    recipe = small(recipe_name, *further)
    task = build_task(recipe, root)
    (role,) = task.released
    network = spread_norms(task.networks[role]).eval()
    if isinstance(task, FrontTranslation) and hasattr(network, "logits"):
        balance(task, network)
    card = Card(network=recipe.networks[role].model, settings=dict(recipe.networks[role].settings), **task.card(role))
    save(folder / f"{role}.safetensors", network, card, dtype=torch.float32)
    return task, folder


def balance(task: FrontTranslation, network: nn.Module) -> None:
    """Let an untrained network name several classes: its scores have the same mean."""
    means: list[Tensor] = []
    hook = network.logits.register_forward_hook(lambda _, __, out: means.append(out.mean((0, 2, 3))))
    task.predict(task.validation[0])
    hook.remove()
    network.logits.bias.data -= means[0]


# --- the paper's systems see what their tasks see --------------------------------------------------------------------


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
    assert isinstance(one, Front) and not one.told and isinstance(task, FrontTranslation)
    past, seen = one.see(at(frame))
    sample = task.validation[0]
    wanted = TABLES["common-14", "common-15"][task.predict(sample).numpy()]
    assert past is None and seen.colour is None and seen.panorama is None
    assert np.array_equal(seen.ids, wanted) and len(np.unique(wanted)) > 1
    assert np.array_equal(seen.labels, task.validation.moment(0).scan.label)
    if isinstance(task, FrontDepthTranslation):
        assert np.allclose(seen.depth_m, task.both(sample)[1], atol=1e-4)
    else:
        assert seen.depth_m is None
    assert list(seen.milliseconds) == FRONT_STAGES


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
    assert isinstance(one, Direct) and not one.told and isinstance(task, DirectColour)
    _, seen = one.see(at(frame))
    wanted = (task.render(0)[0].movedim(0, 2).numpy() + 1) * 127.5
    assert seen.colour is not None and np.abs(seen.colour - wanted).max() <= 0.501
    assert wanted.std() > 0.1
    assert (seen.labels, seen.ids, seen.panorama) == (None, None, None)
    assert one.see(at(frame, painted=False))[1].colour is None


def test_sc_unet_with_range_on_the_raster_of_its_card(root, frame, tmp_path):
    card = {"views": {"camera": {"rows": 24, "columns": 80}}}
    path = write_weights(tmp_path, "renderer", "scunet", {"inputs": 2, "widths": [4, 8, 8]}, **card)
    one = system(path, device="cpu")
    assert isinstance(one, Direct)
    shown: list[Tensor] = []

    def answer(x: Tensor) -> Tensor:
        shown.append(x)
        return torch.zeros(1, 3, *x.shape[2:])

    _, seen = replace(one, renderer=_Function(answer)).see(at(frame))
    from lidar2pano.data.camera_rasters import camera_raster
    from lidar2pano.train.direct import camera_evidence

    calibration = frame.calibration(CAMERA)
    wanted = camera_evidence(camera_raster(frame.scan(), calibration, (24, 80))[None], 2)
    assert torch.equal(shown[0], wanted) and (wanted[0, 1] > 0).any()
    assert seen.colour is not None and seen.colour.shape == (CAMERA[1], CAMERA[0], 3) and (seen.colour == 128).all()


class _Function(nn.Module):
    def __init__(self, function) -> None:
        super().__init__()
        self.function = function

    def forward(self, *inputs: Tensor):
        return self.function(*inputs)


class Sides(nn.Module):
    """A translator: `left` in the left half of its picture, `right` in the right half; it keeps what it was shown."""

    def __init__(self, left: int, right: int, size: tuple[int, int] | None = None) -> None:
        super().__init__()
        self.left, self.right, self.size = left, right, size

    def forward(self, image, condition):
        self.shown = image, condition
        height, width = self.size or image.shape[2:]
        logits = torch.zeros(1, 15 if self.size else 16, height, width)
        logits[:, self.left, :, : width // 2], logits[:, self.right, :, width // 2 :] = 1, 1
        return logits if self.size else (logits, torch.full((1, height, width), 7.0))


def test_the_front_is_stretched_to_the_cameras_image(front_weights, frame):
    plain = system(front_weights, device="cpu")
    assert isinstance(plain, Front)
    question = Question(scan=street(), calibration=frame.calibration((320, 96)))
    seen = replace(plain, translator=(sides := Sides(CAR, ROAD, size=(2, 4)))).see(question)[1]
    assert seen.ids.shape == (96, 320) and seen.labels.shape == (len(street()),)
    assert (seen.ids[:, :159] == CAR).all() and (seen.ids[:, 161:] == ROAD).all()
    image, condition = sides.shown
    front = project(street(), FRONT_VIEW)
    assert torch.equal(image[0], Normalisation()(front))
    assert torch.equal(condition[0].argmax(0), front.spread(torch.from_numpy(seen.labels)))


# --- ours ------------------------------------------------------------------------------------------------------------


def test_a_panorama_is_looked_up_from_the_camera(random_weights, kitti):
    plain = system(random_weights, device="cpu")
    assert isinstance(plain, Around)
    one = replace(plain, pipeline=replace(plain.pipeline, translator=(sides := Sides(CAR, ROAD))))
    _, seen = one.see(Question(scan=street(), calibration=kitti, painted=False))
    assert torch.equal(sides.shown[0][0], project(street(), at_camera(one.pipeline.view, kitti)).channels)
    assert seen.ids.shape == (376, 1241) and seen.labels.shape == (len(street()),)
    assert (seen.ids[:5, 590:620] == 0).all()  # ahead, the panorama reaches up to tan 0.24: row 180 - 0.24 * 718.9
    assert (seen.ids[16:, :600] == CAR).all() and (seen.ids[16:, 615:] == ROAD).all()  # ahead is column 607
    assert (seen.depth_m[16:] == 7).all() and seen.depth_m[0, 600] == 0
    assert seen.colour is None and seen.panorama is None
    assert list(seen.milliseconds) == FRONT_STAGES


def test_colours_are_those_of_the_pipeline(random_weights, kitti):
    one = system(random_weights, device="cpu")
    question = Question(scan=street(), calibration=kitti, origin=kitti.centre)
    memory, seen = one.see(question)
    wanted = load(random_weights, "cpu").at(kitti)(street())
    assert seen.panorama is not None and seen.painted and seen.panorama.view == wanted.view
    assert np.array_equal(seen.panorama.colour, wanted.colour)
    assert np.array_equal(seen.panorama.depth_m, wanted.depth_m)
    assert np.array_equal(seen.colour, wanted.to_camera(kitti).colour)
    assert list(seen.milliseconds) == [*FRONT_STAGES[:-1], "paint", "finish", "camera"]
    assert one.see(question, memory)[1].panorama.frame == 1  # the stream goes on
    assert one.see(question)[1].panorama.frame == 0


def test_steady_systems_are_told_the_poses(random_weights, front_weights, kitti):
    plain, steady = (system(f"{random_weights}{more}", device="cpu") for more in ("", "+steady"))
    assert isinstance(steady, Around) and steady.origin.name == f"{random_weights}+steady" and not plain.steady
    moments = [(street(), np.eye(4)), (drop_points(street(), np.random.default_rng(1), 0.3), np.eye(4))]
    seen = {}
    for one in (plain, steady):
        memory = None
        for scan, pose in moments:
            memory, seen[one] = one.see(Question(scan=scan, origin=kitti.centre, pose=pose), memory)
    wanted = list(load(random_weights, "cpu").at(kitti).stream([scan for scan, _ in moments], [np.eye(4)] * 2))[1]
    assert np.array_equal(seen[steady].panorama.colour, wanted.colour)
    assert not np.array_equal(seen[plain].panorama.colour, wanted.colour)
    with pytest.raises(InputError, match="leave \\+steady out"):
        system(f"{front_weights}+steady", device="cpu")


def test_a_panorama_around_another_point_is_a_run_of_its_own(random_weights, kitti):
    one = system(random_weights, device="cpu")
    _, apart = one.see(Question(scan=street(), calibration=kitti, origin=(0.0, 0.0, 0.5)))
    _, camera = one.see(Question(scan=street(), calibration=kitti, origin=kitti.centre))
    _, alone = one.see(Question(scan=street(), origin=(0.0, 0.0, 0.5)))
    assert apart.panorama.view.origin == (0.0, 0.0, 0.5) == alone.panorama.view.origin
    assert np.array_equal(apart.panorama.colour, alone.panorama.colour)
    assert not np.array_equal(apart.panorama.colour, camera.panorama.colour)
    assert np.array_equal(apart.colour, camera.colour) and np.array_equal(apart.ids, camera.ids)
    assert alone.ids is None and alone.colour is None


def test_without_a_painter_there_are_no_colours(tmp_path, kitti):
    (write_family(tmp_path / "all") / "painter.safetensors").unlink()
    one = system(tmp_path / "all", device="cpu")
    _, seen = one.see(Question(scan=street(), calibration=kitti, origin=kitti.centre))
    assert seen.colour is None and not seen.painted
    assert seen.panorama is not None and len(np.unique(seen.panorama.segments)) > 1


def test_points_alone(random_weights, front_weights):
    for weights in (random_weights, front_weights):
        one = system(weights, device="cpu")
        _, seen = one.see(Question(scan=street()))
        assert seen.labels is not None and seen.labels.shape == (len(street()),)
        assert seen.ids is None and seen.panorama is None and not seen.milliseconds


def test_another_sensor(random_weights, front_weights):
    for weights in (random_weights, front_weights):
        one = system(weights, device="cpu", sensor="pandar64")
        segmenter = one.pipeline.segmenter if isinstance(one, Around) else one.segmenter
        assert segmenter.view == VIEWS["pandar64"]
    with pytest.raises(InputError, match="no sensor 'pandar'; did you mean 'pandar64'"):
        system(random_weights, device="cpu", sensor="pandar")


# --- chains ----------------------------------------------------------------------------------------------------------


def test_a_translator_and_a_painter_of_films(front_weights, film, frame):
    one = system(f"{front_weights}+{film}", device="cpu")
    assert one.origin.name == f"{front_weights}+{film}"
    assert set(one.origin.networks) == {"segmenter", "translator", "painter"}
    bare = system(front_weights, device="cpu")
    past, first = one.see(at(frame))
    assert np.array_equal(first.ids, bare.see(at(frame))[1].ids)
    painter = CameraPainter.from_files(film, None, torch.device("cpu"))
    with torch.inference_mode():
        remembered, wanted = painter.paint(None, torch.from_numpy(first.ids))
        second = painter.paint(remembered, torch.from_numpy(first.ids))[1]
    assert np.array_equal(first.colour, wanted) and first.colour.shape == (CAMERA[1], CAMERA[0], 3)
    assert np.array_equal(one.see(at(frame), past)[1].colour, second) and not np.array_equal(second, wanted)
    assert one.see(at(frame, painted=False))[1].colour is None
    assert system(front_weights, painter=film, device="cpu").origin == one.origin


def test_pictures_are_painted_as_large_as_they_were_learnt(film):
    painter = CameraPainter.from_files(film, None, torch.device("cpu"))
    assert painter.scale == 0.5 and not painter.painter.closed
    seen: list[Tensor] = []

    class Spy:
        def follow(self, past, ids):
            seen.append(ids)
            return past, torch.linspace(-1, 1, ids.shape[1]).expand(3, *ids.shape)

    ids = torch.arange(8)[:, None].expand(8, 12).to(torch.uint8)
    _, colour = replace(painter, painter=Spy()).paint(None, ids)
    assert seen[0].shape == (4, 6) and seen[0][:, 0].tolist() in ([0, 2, 4, 6], [1, 3, 5, 7])
    assert colour.shape == (8, 12, 3) and colour[0, 0, 0] == 0 and colour[0, -1, 0] == 255
    assert (np.diff(colour[0, :, 0].astype(int)) >= 0).all()
    assert learnt_scale(Card(network="vid2vid")) == 1


def test_the_ceiling_paints_what_it_is_told(film, frame):
    one = system("truth", painter=film, device="cpu")
    assert isinstance(one, Ceiling) and one.told and one.origin.name == f"truth+{film}"
    ids = np.zeros((CAMERA[1], CAMERA[0]), np.uint8)
    ids[:, 100:] = ROAD
    _, seen = one.see(at(frame, ids=ids))
    with torch.inference_mode():
        wanted = one.painter.paint(None, torch.from_numpy(ids))[1]
    assert np.array_equal(seen.colour, wanted)
    assert seen.ids is None and seen.labels is None
    assert one.see(at(frame))[1].colour is None  # nobody knows the classes


def test_a_painter_takes_the_familys_place(random_weights, film, kitti, tmp_path):
    one = system(random_weights, painter=film, device="cpu")
    assert isinstance(one, Around)
    assert one.origin.networks["painter"]["network"] == "vid2vid"
    assert set(one.origin.networks) == {"segmenter", "translator", "painter"}


def test_the_default_family_fills_what_a_run_lacks(random_weights, film, tmp_path, monkeypatch):
    monkeypatch.setattr("lidar2pano.models.families.RELEASED", random_weights.parent)
    monkeypatch.setattr("lidar2pano.models.families.DEFAULT", random_weights.name)
    run = tmp_path / "run"
    write_front(run / "weights")
    (run / "weights" / "segmenter.safetensors").unlink()
    front = system(run, device="cpu")
    assert isinstance(front, Front) and front.painter is None  # the family's paints panoramas
    assert front.origin.files["segmenter"].parent == random_weights
    assert isinstance(system(random_weights.name, device="cpu"), Around)
    only = tmp_path / "translator.safetensors"
    only.write_bytes((random_weights / "translator.safetensors").read_bytes())
    assert set(system(only, device="cpu").origin.files) == {"segmenter", "translator", "painter"}
    assert read_card(only).network == "titan-pano"


# --- what does not go together ---------------------------------------------------------------------------------------


def test_what_cannot_be_a_system(random_weights, front_weights, film, tmp_path):
    renderer = write_weights(tmp_path / "r", "renderer", "scunet", {"widths": [4, 8, 8]})
    sdnet = {"width": 4, "stem": 4, "blocks": 1, "modules": [1, 1, 1], "context": 8}
    eye = write_weights(tmp_path / "e", "camera", "sdnet", sdnet, labels="cityscapes")
    write_weights(tmp_path / "two", "a", "scunet", {"widths": [4, 8, 8]})
    write_weights(tmp_path / "two", "b", "scunet", {"widths": [4, 8, 8]})
    (tmp_path / "empty").mkdir()
    translator = random_weights / "translator.safetensors"
    for name, said in {
        str(translator): "translator.safetensors: no weights for the segmenter",
        f"{renderer}+{film}": "a renderer makes colours by itself, so the painter has no place",
        f"{front_weights}+{random_weights / 'painter.safetensors'}": "a 'painter' paints panoramas only",
        "truth": "truth: the true classes have to be painted",
        str(eye): "a 'sdnet' has no part in a system that is evaluated; name it by --sdnet",
        str(tmp_path / "two"): "a.safetensors and b.safetensors are both a renderer; name one of them",
        str(tmp_path / "empty"): "holds no weights",
        "trut": "no weights 'trut': neither a released family nor a file; did you mean 'truth'?",
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
    assert system(folder, device="cpu").origin.name == str(folder)
