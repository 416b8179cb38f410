"""Names are ordered as people count."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from lidar2pano.name_order import sort_listed, sort_names


@pytest.mark.parametrize(
    "ordered",
    [
        ["0.bin", "1.bin", "2.bin", "10.bin", "11.bin", "100.bin"],
        ["scan_1.pcd", "scan_2.pcd", "scan_10.pcd", "scan_10_1.pcd"],
        ["a/9/10.bin", "a/10/2.bin", "a/10/10.bin", "b/1/1.bin"],
        ["000009.bin", "000010.bin", "000100.bin"],
        ["1.5.pcd", "2.25.pcd", "2.5.pcd", "10.125.pcd"],  # times
        ["1.1.pcd", "1.2.pcd", "1.9.pcd", "1.10.pcd", "1.11.pcd"],  # frames of a first drive
        ["1549_5.pcd", "1549_25.pcd"],  # seconds and nanoseconds
        ["01.bin", "1.bin", "2.bin"],
        ["2011.9.26.bin", "2011.10.3.bin"],
        ["1" * 300 + ".bin", "2" * 300 + ".bin", "1" * 301 + ".bin"],
    ],
)
def test_numbers_in_names_compare_as_numbers(ordered):
    for seed in range(5):
        mixed = random.Random(seed).sample(ordered, len(ordered))
        assert sort_names(mixed) == ordered
        assert sort_names(map(Path, mixed)) == [Path(name) for name in ordered]


def test_only_what_a_shell_sorted_is_sorted_again():
    assert sort_listed(["0.bin", "1.bin", "10.bin", "2.bin"]) == ["0.bin", "1.bin", "2.bin", "10.bin"]
    assert sort_listed(["2.bin", "10.bin", "1.bin"]) == ["2.bin", "10.bin", "1.bin"]
