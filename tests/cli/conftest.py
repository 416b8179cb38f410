"""Commands as tests of several modules run them."""

from __future__ import annotations

import pytest

from lidar2pano.cli import main


@pytest.fixture
def translate(random_weights, capsys):
    """A function that runs `translate` with the small family: (exit code, stdout, stderr)."""

    def run(*arguments: object) -> tuple[int, str, str]:
        code = main(["translate", *map(str, arguments), "--weights", str(random_weights), "--device", "cpu"])
        return code, *capsys.readouterr()

    return run
