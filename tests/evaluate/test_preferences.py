"""The page of pairs: every picture is its system's, sides are drawn by name, and no picture says whose it is."""

import json
import re

import numpy as np
import pytest
from PIL import Image

from lidar2pano.errors import InputError
from lidar2pano.evaluate.pictures import Preferences


def grey(value: int) -> np.ndarray:
    return np.full((4, 6, 3), value, np.uint8)


def test_pictures_lie_on_the_side_that_the_page_counts_for_their_system(tmp_path):
    preferences = Preferences(tmp_path, ("one", "other </script>"))
    for number in range(40):
        preferences.take(f"00/{number:06d}", grey(100), [grey(10), grey(200)])
    page = preferences.write().read_text()
    data = json.loads(re.search(r'id="data">(.*?)</script>', page).group(1))
    assert data["systems"] == ["one", "other </script>"]
    swapped = [pair["swapped"] for pair in data["pairs"]]
    assert len(swapped) == 40 and 8 < sum(swapped) < 32
    for pair in data["pairs"]:
        values = [np.array(Image.open(tmp_path / pair[side])).mean() for side in ("real", "left", "right")]
        assert values == [100, *((200, 10) if pair["swapped"] else (10, 200))]
        assert not any("one" in pair[side] or "other" in pair[side] for side in ("left", "right"))
    again = Preferences(tmp_path, ("one", "other"))
    again.take("00/000000", grey(100), [grey(10), grey(200)])
    assert again.pairs[0]["swapped"] == swapped[0]


def test_frames_without_all_three_pictures_are_left_out(tmp_path):
    preferences = Preferences(tmp_path, ("one", "other"))
    preferences.take("a", None, [grey(1), grey(2)])
    preferences.take("b", grey(0), [grey(1), None])
    assert not preferences.pairs
    with pytest.raises(InputError, match="no frame has a photograph and both"):
        preferences.write()


@pytest.mark.parametrize("systems", [("one",), ("one", "two", "three")])
def test_only_two_systems_are_compared(tmp_path, systems):
    with pytest.raises(InputError, match="two systems"):
        Preferences(tmp_path, systems)
