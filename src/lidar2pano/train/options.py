"""The options of every task, one frozen dataclass each, checked when they are made. No torch is imported here."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar, Literal

from lidar2pano.errors import InputError

LARGEST_SIZE = 65_536  # pixels, channels, samples
LARGEST = 1e6  # of weights of losses, degrees, exponents, minutes


def check_range(owner: str, least: float, most: float, **values: float | tuple[float, ...]) -> None:
    """Raise InputError for the first value (or part of a tuple) that does not lie between `least` and `most`."""
    for name, value in values.items():
        for number in value if isinstance(value, tuple) else (value,):
            if not least <= number <= most:
                raise InputError(f"{owner}.{name}={number:g} must be at least {least:g} and at most {most:g}")


@dataclass(frozen=True, kw_only=True)
class TaskOptions:
    """Options of one task; numbers lie between 0 and LARGEST, those whose names end in _probability at most at 1.

    task   the task's name in `tasks.TASKS`;  SIZES: names of sizes, 1 to LARGEST_SIZE.
    """

    task: ClassVar[str]
    SIZES: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        """Refuse values out of range and words that are not offered (InputError)."""
        for name in (field.name for field in fields(self)):
            value = getattr(self, name)
            numbers = value if isinstance(value, tuple) else (value,)
            if not all(isinstance(number, int | float) for number in numbers):
                continue
            least, most = (1, LARGEST_SIZE) if name in self.SIZES else (0, LARGEST)
            if name.endswith("_probability"):
                most = 1
            check_range("options", least, most, **{name: numbers})


@dataclass(frozen=True, kw_only=True)
class SegmentationOptions(TaskOptions):
    """A range-view segmenter.

    columns                width of the azimuth crop; 0: all of the view.
    rotation_deg           largest rotation about the vertical axis, either way.
    augment_probability    of each of shifting, rotating and dropping points.
    remission_scale        largest relative change of a scan's remission.
    ring_drop_probability  of leaving out up to three quarters of the beams.
    remission_drop_probability  of a scan without remission.
    lovasz                 weight of Lovasz-Softmax beside the cross-entropy.
    class_weight_exponent,
    class_weight_least,
    class_weight_most      class weights in the cross-entropy are (share of the points, at least `least`) ** -exponent,
                           divided by their mean, at most `most`.
    dropout                whether the network's dropout is on;  fixed_norms: whether norms keep their statistics.
    tallest                name of the view as far as which rows are added for scans that go beyond the recipe's view
                           (geometry.projection.fitted_view); "": none are.
    teacher, distillation  weight file of a segmenter whose predictions are learned beside the labels (knowledge
                           distillation), "": none;  weight of that loss.
    """

    task = "segmentation"
    columns: int = 1024
    rotation_deg: float = 180.0
    augment_probability: float = 0.5
    remission_scale: float = 0.0
    ring_drop_probability: float = 0.0
    remission_drop_probability: float = 0.0
    lovasz: float = 1.0
    class_weight_exponent: float = 0.5
    class_weight_least: float = 1e-5
    class_weight_most: float = 6.0
    dropout: bool = True
    fixed_norms: bool = False
    tallest: str = ""
    teacher: str = ""
    distillation: float = 2.0


@dataclass(frozen=True, kw_only=True)
class CameraSegmentationOptions(TaskOptions):
    """A camera segmenter (SD-Net).

    rows, columns         size of the crops, pixels;  scale_min, scale_max: range of the random resizing.
    colour_jitter         brightness, contrast and saturation change by factors in [1 - jitter, 1 + jitter].
    lovasz                weight of Lovasz-Softmax of the joint output.
    auxiliary, per_scale  weights of the cross-entropies of OCR's first output and of every scale by itself.
    """

    task = "camera-segmentation"
    SIZES = ("rows", "columns")
    rows: int = 1024
    columns: int = 2048
    scale_min: float = 0.5
    scale_max: float = 2.0
    colour_jitter: float = 0.25
    lovasz: float = 1.0
    auxiliary: float = 0.4
    per_scale: float = 0.05

    def __post_init__(self) -> None:
        """Refuse what TaskOptions refuses, and sizes that are none (InputError)."""
        super().__post_init__()
        check_range("options", 0.01, self.scale_max, scale_min=self.scale_min)
        check_range("options", self.scale_min, 16, scale_max=self.scale_max)
        check_range("options", 0, 1, colour_jitter=self.colour_jitter)


@dataclass(frozen=True, kw_only=True)
class FrontOptions(TaskOptions):
    """TITAN-Net.

    gradient_penalty  weight (lambda) of the WGAN's gradient penalty;  lovasz: weight of Lovasz-Softmax; 0: none.
    segments          the condition: "predicted" by a segmenter, or the "data"'s own (in validation the segmenter's).
    segmenter         weight file whose labels these are; "": predicted_labels/ of the data, which `prepare` writes.
    """

    task = "front"
    gradient_penalty: float = 10.0
    lovasz: float = 1.0
    segments: Literal["predicted", "data"] = "data"
    segmenter: str = ""


@dataclass(frozen=True, kw_only=True)
class FrontDepthOptions(FrontOptions):
    """TITAN-Next: beside TITAN-Net's options the weights of cross-entropy and of the distance of depth codes."""

    task = "front-depth"
    lovasz: float = 0.1
    cross_entropy: float = 0.1
    depth: float = 0.1


@dataclass(frozen=True, kw_only=True)
class FrontColourOptions(TaskOptions):
    """Colours from the front view: weights of the squared error and of the WGAN's gradient penalty."""

    task = "front-colour"
    mse: float = 1.0
    gradient_penalty: float = 10.0


@dataclass(frozen=True, kw_only=True)
class CameraColourOptions(TaskOptions):
    """Colours from the scan projected into the camera (SC-UNET).

    mse   weight of the squared error;  size: rows and columns of the image.
    """

    task = "camera-colour"
    SIZES = ("size",)
    mse: float = 1.0
    size: tuple[int, int] = (376, 1241)


@dataclass(frozen=True, kw_only=True)
class Pix2PixOptions(TaskOptions):
    """Pix2Pix: the discriminator's loss, the auxiliary loss of the generator and its weight."""

    gan_mode: Literal["vanilla", "lsgan"] = "vanilla"
    auxiliary: Literal["l1", "mse"] = "l1"
    auxiliary_weight: float = 100.0


@dataclass(frozen=True, kw_only=True)
class Pix2PixSegmentsOptions(Pix2PixOptions):
    """Pix2Pix in TITAN-Net's place; segments, segmenter: as for TITAN-Net."""

    task = "pix2pix-segments"
    segments: Literal["predicted", "data"] = "data"
    segmenter: str = ""


@dataclass(frozen=True, kw_only=True)
class Pix2PixColoursOptions(Pix2PixOptions):
    """Pix2Pix from the front view to colours."""

    task = "pix2pix-colours"


@dataclass(frozen=True, kw_only=True)
class PanoramaOptions(TaskOptions):
    """TITAN-pano.

    columns                width of the crop around the camera's sector.
    lovasz, depth          weights of Lovasz-Softmax and of the distance of depth codes.
    class_weight_exponent  class weights in the cross-entropy are (share of the pixels) ** -exponent.
    segmenter              weight file whose labels take half of the training samples and all of validation;
                           "": the labels of the data everywhere.
    teacher, distillation  weight file of a translator whose classes and depths are learned beside the ground truth
                           (knowledge distillation), "": none;  weight of that loss.
    elsewhere_probability  with a teacher, of a crop of a real frame that begins anywhere, also where no camera looked.
    """

    task = "panorama"
    SIZES = ("columns",)
    columns: int = 576
    lovasz: float = 1.0
    depth: float = 2.0
    class_weight_exponent: float = 0.5
    segmenter: str = ""
    teacher: str = ""
    distillation: float = 2.0
    elsewhere_probability: float = 1.0


@dataclass(frozen=True, kw_only=True)
class ScenePaintingOptions(TaskOptions):
    """The scene painter.

    columns                    width of a crop on the translator's raster.
    perceptual, pooled,
    pixels, adversarial        weights of the losses; no discriminator where the last is 0.
    fringes                    weight of what single pixels differ in hue from those around them, beyond what images do.
    unseen                     weight of the distance of colours where no camera looked from the means of their classes.
    walls                      weight of how far the hues of walls are from the mean of houses in the look and the
                               house's tone; a teacher's pictures are corrected in it.
    objects                    weight of how far the hues of vehicles, people and signs are from those of their tones; a
                               teacher's pictures are corrected in it.
    texture                    weight of the distance between distributions of bands of frequency, class by class.
    streaks                    weight of lines along rows that are painted on roads and in panes and that no image has.
    statistics                 weight of the distance of the painted patches' features from the real ones' distribution.
    on_invented                share of the perceptual and the pixels' loss that counts on what is invented.
    invented_probability       of crops whose houses, cars, people and signs have the tones and openings of use, not the
                               image's, with which they are then hardly compared.
    ground_truth_probability   of samples painted from the ground truth's classes, where they are known.
    sharpest                   largest power that class probabilities are raised to.
    remission_scale            largest relative change of a crop's remission.
    remission_drop_probability  of a crop without remission.
    simulated_probability      where there are real and simulated frames: of the second of a sample's two crops being
                               of a simulated frame; otherwise it is of a real one, as the first.
    elsewhere_probability      of a crop that begins anywhere, also where no camera looked, and only the discriminator
                               and the classes' colours teach. 0: none does, and the files of frames are smaller.
    augment_probability        of each kind of DiffAugment.
    fixed_norms                whether norms keep their statistics.
    look                       of frames that no simulator made; "": the painter's own.
    cache                      folder that keeps what is made of each frame, some 5 MB of a camera's view and 25 MB of
                               a panorama; "": the folder .lidar2pano of its data set.
    translator, segmenter      weight files of the networks whose output is painted.
    teacher                    weight file of a painter of the same looks, whose pictures take the place of the images
                               where no camera looked (knowledge distillation); "": none.
    teacher_probability        of crops that are the teacher's picture altogether, in a look drawn at random.
    """

    task = "scene-painting"
    SIZES = ("columns",)
    columns: int = 256
    perceptual: float = 2.0
    pooled: float = 6.0
    pixels: float = 0.2
    adversarial: float = 0.35
    fringes: float = 0.0
    unseen: float = 1.0
    walls: float = 0.0
    objects: float = 0.0
    texture: float = 0.0
    streaks: float = 0.0
    statistics: float = 1.0
    on_invented: float = 0.2
    invented_probability: float = 0.0
    ground_truth_probability: float = 0.6
    sharpest: float = 4.0
    remission_scale: float = 0.0
    remission_drop_probability: float = 0.0
    simulated_probability: float = 0.5
    elsewhere_probability: float = 0.0
    augment_probability: float = 0.0
    fixed_norms: bool = False
    look: str = ""
    cache: str = ""
    translator: str = ""
    segmenter: str = ""
    teacher: str = ""
    teacher_probability: float = 0.5


@dataclass(frozen=True, kw_only=True)
class VideoOptions(TaskOptions):
    """vid2vid.

    source                   "camera" images, or the "panorama" ground truth that simulated data sets have.
    clip_length              frames of a clip, of which the first two are given;  rows, columns: of its window.
    single_frame_splits      splits whose frames do not follow each other; a window pans over each.
    no_previous_probability  of clips that begin without previous images, as a stream does.
    first_frame_weights      weight file of the first-frame network that begins the clips of validation; "": they begin
                             with nothing or, where no_previous_probability is 0, with ground truth.
    feature_matching, flow, coherence, mask, perceptual, pixels: weights of losses.
    vgg_weights              file of VGG-19's weights; "": no perceptual loss.
    """

    task = "video"
    SIZES = ("clip_length", "rows", "columns")
    source: Literal["camera", "panorama"] = "camera"
    clip_length: int = 12
    rows: int = 160
    columns: int = 512
    single_frame_splits: tuple[str, ...] = ()
    no_previous_probability: float = 0.33
    first_frame_weights: str = ""
    feature_matching: float = 10.0
    flow: float = 10.0
    coherence: float = 10.0
    mask: float = 1.0
    perceptual: float = 10.0
    pixels: float = 0.0
    vgg_weights: str = ""
