"""Display of a run: a line of progress, curves and previews. Only the first process has a monitor."""

from __future__ import annotations

import logging
import secrets
import sys
import time
from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path
from types import ModuleType

import numpy as np
from PIL import Image
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Column

from lidar2pano.formats.image_files import write_whole

log = logging.getLogger(__name__)
SHOW_EVERY_S = 1.0  # the bar
LOG_EVERY_S = 20.0  # a line in the log, without a terminal


class Monitor:
    """A bar on a terminal or lines in the log, TensorBoard curves in RUN/tensorboard, images in RUN/preview."""

    def __init__(self, run: Path, name: str, steps: int, step: int) -> None:
        # TensorBoard's own sign to do without TensorFlow, which takes seconds to import and raises errors of its own
        sys.modules.setdefault("tensorboard.compat.notf", ModuleType("notf"))
        from torch.utils.tensorboard import SummaryWriter

        self.run, self.name, self.steps = run, name, steps
        suffix = f".{secrets.token_hex(8)}"  # nobody can plant a link of this name
        self.curves = SummaryWriter(str(run / "tensorboard"), purge_step=step, filename_suffix=suffix)
        self.losses: dict[str, float] = {}
        self.first: tuple[int, float, float] | None = None
        self.last_line = time.monotonic()
        self.bar: Progress | None = None
        if sys.stderr.isatty() and log.isEnabledFor(logging.INFO):
            line = TextColumn("{task.fields[state]}", table_column=Column(no_wrap=True, overflow="ellipsis"))
            columns = (TextColumn("{task.description}"), BarColumn(bar_width=20), line)
            self.bar = Progress(*columns, console=Console(file=sys.stderr), refresh_per_second=2)
            self.line = self.bar.add_task(name, total=1.0, state="")
            self.bar.start()

    def due(self) -> bool:
        """Tell if a new line is due."""
        return time.monotonic() - self.last_line >= (SHOW_EVERY_S if self.bar else LOG_EVERY_S)

    def step(self, step: int, progress: float, values: Mapping[str, float]) -> None:
        """Update the line and the curves: means of losses, and rates under "rate/"; `progress` of the run is 0 to 1."""
        now = time.monotonic()
        if self.first is None:  # the steps before the first line warm up: they do not count
            self.first = (step, progress, now)
        self.last_line = now
        self.losses |= {name: value for name, value in values.items() if "/" not in name}
        state = f"{step}/{self.steps}  {_formatted(self.losses)}  {self._pace(step, progress, now)}"
        if self.bar:
            self.bar.update(self.line, completed=min(progress, 1.0), state=state)
        else:
            log.info("%s %s", self.name, state)
        for name, value in values.items():
            self.curves.add_scalar(name, value, step)

    def _pace(self, step: int, progress: float, now: float) -> str:
        first_step, done, began = self.first or (step, progress, now)
        if step == first_step or progress <= done:
            return ""
        left = (1 - min(progress, 1.0)) * (now - began) / (progress - done)
        return f"{(now - began) / (step - first_step):.2f} s/step  {timedelta(seconds=round(left))} left"

    def scores(self, step: int, scores: Mapping[str, float]) -> None:
        """Curves under "val/" and a line in the log."""
        for name, value in scores.items():
            self.curves.add_scalar(f"val/{name}", value, step)
        log.info("%s step %d validation: %s", self.name, step, _formatted(scores))

    def previews(self, step: int, images: Mapping[str, np.ndarray]) -> None:
        """Write RUN/preview/<step>-<name>.png, and the same to TensorBoard; images are (H, W, 3) uint8."""
        folder = self.run / "preview"
        folder.mkdir(exist_ok=True)
        for name, image in images.items():
            path = folder / f"{step:07d}-{name}.png"
            write_whole(path, lambda part, image=image: Image.fromarray(image).save(part, format="png"))
            self.curves.add_image(name, image, step, dataformats="HWC")

    def close(self) -> None:
        """Stop the bar and flush the curves."""
        if self.bar:
            self.bar.stop()
        self.curves.close()


def _formatted(values: Mapping[str, float]) -> str:
    return "  ".join(f"{name} {value:.4g}" for name, value in values.items())
