"""Colour differences: CIEDE2000 against the published pairs, and the colours of classes."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.color import deltaE_ciede2000, rgb2lab

from lidar2pano.labels import COMMON15
from lidar2pano.metrics.frame_metrics import ClassColourError, ciede2000, lab, linear_light

# Sharma, Wu, Dalal 2005, table 1: two colours in Lab, and their difference.
PAIRS = """
50 2.6772 -79.7751 50 0 -82.7485 2.0425
50 3.1571 -77.2803 50 0 -82.7485 2.8615
50 2.8361 -74.0200 50 0 -82.7485 3.4412
50 -1.3802 -84.2814 50 0 -82.7485 1.0000
50 -1.1848 -84.8006 50 0 -82.7485 1.0000
50 -0.9009 -85.5211 50 0 -82.7485 1.0000
50 0 0 50 -1 2 2.3669
50 -1 2 50 0 0 2.3669
50 2.4900 -0.0010 50 -2.4900 0.0009 7.1792
50 2.4900 -0.0010 50 -2.4900 0.0010 7.1792
50 2.4900 -0.0010 50 -2.4900 0.0011 7.2195
50 2.4900 -0.0010 50 -2.4900 0.0012 7.2195
50 -0.0010 2.4900 50 0.0009 -2.4900 4.8045
50 -0.0010 2.4900 50 0.0010 -2.4900 4.8045
50 -0.0010 2.4900 50 0.0011 -2.4900 4.7461
50 2.5 0 50 0 -2.5 4.3065
50 2.5 0 73 25 -18 27.1492
50 2.5 0 61 -5 29 22.8977
50 2.5 0 56 -27 -3 31.9030
50 2.5 0 58 24 15 19.4535
50 2.5 0 50 3.1736 0.5854 1.0000
50 2.5 0 50 3.2972 0 1.0000
50 2.5 0 50 1.8634 0.5757 1.0000
50 2.5 0 50 3.2592 0.3350 1.0000
60.2574 -34.0099 36.2677 60.4626 -34.1751 39.4387 1.2644
63.0109 -31.0961 -5.8663 62.8187 -29.7946 -4.0864 1.2630
61.2901 3.7196 -5.3901 61.4292 2.2480 -4.9620 1.8731
35.0831 -44.1164 3.7933 35.0232 -40.0716 1.5901 1.8645
22.7233 20.0904 -46.6940 23.0331 14.9730 -42.5619 2.0373
36.4612 47.8580 18.3852 36.2715 50.5065 21.2231 1.4146
90.8027 -2.0831 1.4410 91.1528 -1.6435 0.0447 1.4441
90.9257 -0.5406 -0.9208 88.6381 -0.8985 -0.7239 1.5381
6.7747 -0.2908 -2.4247 5.8714 -0.0985 -2.2286 0.6377
2.0776 0.0795 -1.1350 0.9033 -0.0636 -0.5514 0.9082
"""


def pairs() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    table = np.array([line.split() for line in PAIRS.strip().splitlines()], dtype=np.float64)
    return table[:, :3], table[:, 3:6], table[:, 6]


def test_differences_are_the_published_ones():
    first, second, difference = pairs()
    assert len(difference) == 34
    np.testing.assert_allclose(ciede2000(first, second), difference, atol=5.1e-5)
    np.testing.assert_allclose(ciede2000(second, first), difference, atol=5.1e-5)


def test_differences_agree_with_a_second_implementation():
    codes = np.random.default_rng(1).integers(0, 256, (2, 4000, 3))
    first, second = lab(linear_light(codes))
    np.testing.assert_allclose(first, rgb2lab(codes[0] / 255), atol=0.02)
    np.testing.assert_allclose(ciede2000(first, second), deltaE_ciede2000(first, second), atol=1e-9)


@pytest.mark.parametrize(("code", "light"), [(0, 0.0), (255, 1.0), (188, 0.5029), (10, 10 / 255 / 12.92)])
def test_light_of_codes(code, light):
    assert linear_light(np.array(code)) == pytest.approx(light, abs=1e-4)


def test_colours_of_classes_are_compared_by_their_means():
    road, car = COMMON15.id_of("road"), COMMON15.id_of("car")
    classes = np.zeros((4, 8), dtype=np.uint8)
    classes[1:, :4], classes[1:, 4:6] = road, car
    real = np.full((4, 8, 3), 100, dtype=np.uint8)
    painted = real.copy()
    painted[classes == car] = (200, 10, 10)
    painted[0] = 255  # unlabeled
    metric = ClassColourError()
    metric.update(painted, real, classes, "a")
    values = {name: float(value) for name, value in metric.values().items()}
    expected = float(ciede2000(*(lab(linear_light(np.array(colour))) for colour in ((200, 10, 10), (100,) * 3))))
    assert values["class colour error road"] == 0
    assert values["class colour error car"] == pytest.approx(expected)
    assert values["class colour error"] == pytest.approx(expected * 6 / 18)
    assert np.isnan(values["class colour error sky"])
    textured = real.copy()
    textured[1, :4], textured[2, :4] = 60, 128  # the mean light is what counts
    metric = ClassColourError()
    metric.update(textured, real, classes, "a")
    assert float(next(iter(metric.values().values()))) < 1.5


def test_other_sizes_are_refused():
    image = np.zeros((4, 8, 3), dtype=np.uint8)
    with pytest.raises(ValueError, match="differ in size"):
        ClassColourError().update(image, image[:2], np.zeros((4, 8), dtype=np.uint8), "a")
