"""Exposure of a camera that took no image, by those of the cameras beside it.

A panorama has one exposure; a camera meters its own view. Two guesses at the mean level (code of sRGB) of its image:
that of the others' images, if each meters its own view, and that of the panorama there, if they share one exposure.
Their variances are those of the others' levels, and of the gains between the others; both guesses are averaged by
their inverse variances.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidar2pano.geometry.stitching import Camera


def metered_gain(level: float, cameras: Sequence[Camera], levels: Sequence[float]) -> float:
    """Return the factor from a panorama's codes to those of a camera without an image; 1 if the others do not tell.

    level   mean code of the panorama in its view.
    levels  mean codes of the images of `cameras`, whose gains are the panorama's.
    """
    if len(cameras) < 2 or min(level, *levels) <= 0:
        return 1.0
    own, gain = np.log(levels), np.log([np.mean(camera.gain) for camera in cameras])
    metered_variance, shared_variance = own.var(ddof=1), gain.var(ddof=1)
    if shared_variance == 0:
        return 1.0
    share = shared_variance / (metered_variance + shared_variance)
    metered, shared = own.mean() - np.log(level), -gain.mean()
    return float(np.exp(share * metered + (1 - share) * shared))
