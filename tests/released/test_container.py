"""The Dockerfile's steps, taken in an empty environment, make a service that answers at once.

It downloads 300 MB. Docker's own part is not tried: the base image, and the user without rights.
"""

from __future__ import annotations

import io
import os
import shlex
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from PIL import Image as Picture

from dockerfile import STEPS, Image, build, health_command, words_of
from lidar2pano.demo import street

PORT = "8360"
of_linux = pytest.mark.skipif(sys.platform != "linux", reason="the image is one of Linux")
pytestmark = [pytest.mark.released, pytest.mark.xdist_group("image")]


@pytest.fixture(scope="module")
def image(tmp_path_factory) -> Image:
    """The image; a TORCH_INDEX in the environment replaces the one of the Dockerfile, as with make."""
    (default,) = [rest.partition("=")[2] for name, rest in STEPS if name == "ARG" and rest.startswith("TORCH_INDEX=")]
    index = os.environ.get("TORCH_INDEX", default)
    probe = (
        f"import urllib.request as r; r.urlopen('{index}/torch/', timeout=30)"  # a child may: tests reach no network
    )
    if subprocess.run([sys.executable, "-c", probe], capture_output=True, check=False).returncode:
        pytest.skip(f"{index} cannot be reached; TORCH_INDEX=URL names another")
    return build(tmp_path_factory.mktemp("image"), {"TORCH_INDEX": index})


@contextmanager
def service(image: Image) -> Iterator[str]:
    """Start the image's command, on a free port; yields the port."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = str(probe.getsockname()[1])
    words = [*words_of("ENTRYPOINT"), *words_of("CMD"), "--port", port]
    words[0] = str(image.place("/venv/bin") / words[0])
    with subprocess.Popen(words, **image.surroundings(), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout and process.stdout.readline()
        yield port
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0


@of_linux
def test_the_image_is_free_of_other_licences_and_of_its_sources(image):
    listed = image.run("lidar2pano weights list")
    assert "world" in listed.stdout and "streets" not in listed.stdout, listed.stderr
    assert list(image.place("/build").iterdir()) == [] and not image.place("/tmp/demo").exists()


@of_linux
def test_the_service_answers_with_the_networks_that_the_image_has_compiled(image):
    cache = image.place("/home/lidar2pano/cache")
    compiled = sorted(path.name for path in cache.iterdir())
    assert compiled, "LIDAR2PANO_ENGINE and LIDAR2PANO_CACHE hold while the image is built"
    with service(image) as port:
        health = [word.replace(PORT, port) for word in health_command()]
        end = time.monotonic() + 120
        while (well := image.run(shlex.join(health))).returncode and time.monotonic() < end:
            time.sleep(1)
        assert well.returncode == 0, well.stderr
        request = urllib.request.Request(f"http://127.0.0.1:{port}/panorama", Path(street()).read_bytes())
        with urllib.request.urlopen(request, timeout=300) as answer:
            assert Picture.open(io.BytesIO(answer.read())).size == (4608, 384)
    assert sorted(path.name for path in cache.iterdir()) == compiled
