"""The scene painter's options and recipes. No torch is imported here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from lidar2pano.train.recipe import Network, Optimizer, Recipe, TaskOptions, Training, on_two_cores, vary


@dataclass(frozen=True, kw_only=True)
class ScenePaintingOptions(TaskOptions):
    """The scene painter.

    columns                    width of a crop on the translator's raster.
    perceptual, pooled,
    pixels, adversarial        weights of the losses; no discriminator where the last is 0.
    unseen                     weight of the distance of colours where no camera looked from the means of their classes.
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
    unseen: float = 1.0
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


def scene_painter() -> Recipe[ScenePaintingOptions]:
    """The scene painter: colour from segments and the shape of things, against heads on frozen features."""
    painter = Optimizer(algorithm="adam", rate=1e-3, betas=(0.5, 0.99), warmup=10, clip=5.0)
    critic = Optimizer(algorithm="adam", rate=5e-4, betas=(0.0, 0.99), schedule="constant")
    unread = ("building", "vegetation", "fence")
    settings = {"looks": ("day", "overcast", "autumn", "evening"), "look": "day", "unread": unread}
    settings |= {"bilinear": True, "glass": True, "sun": False}
    return Recipe(
        view="panorama",
        scale=0.5,
        networks={
            "painter": Network(model="scene-painter", settings=settings, optimizer=painter),
            "critic": Network(model="projected-critic", optimizer=critic),
        },
        options=ScenePaintingOptions(
            columns=320,
            adversarial=0.6,
            augment_probability=0.4,
            simulated_probability=0.3,
            remission_scale=0.3,
            remission_drop_probability=0.15,
        ),
        training=Training(steps=50_000, batch=8),
    )


def fast_painter() -> Recipe:
    """`scene_painter` with a third of the arithmetic, taught by a wide one, whose norms' statistics it has."""
    settings = {"widths": (16, 32, 80, 16), "colour_kernel": 1, "sharp": 4.0, "class_colours": False}
    return vary(scene_painter(), painter=settings, options={"fixed_norms": True})


RECIPES: dict[str, Callable[[], Recipe]] = {
    "scene-painter": scene_painter,
    "scene-painter-mini": lambda: on_two_cores(scene_painter(), minutes=40, batch=2, ema=0.99),
    "fast-painter": fast_painter,
    "fast-painter-mini": lambda: on_two_cores(fast_painter(), minutes=30, batch=1, ema=0.99),
}
