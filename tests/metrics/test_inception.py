"""The Inception-v3 of FID: the same features as torch-fidelity's class, and no weights but the published ones.

The published weights are not at hand, so both networks are filled by the rule of `golden_fill`. What torch-fidelity
0.4.0 (Apache 2.0) answered is recorded below; where it is installed, it is asked again.
"""

from __future__ import annotations

import hashlib
import os

import numpy as np
import pytest
import torch

from golden_fill import fill, unit
from lidar2pano.errors import InputError
from lidar2pano.metrics import inception
from lidar2pano.metrics.inception import Inception, find_inception, load_inception, resized
from metric_definitions import fidelity_inception

GAIN = 1.4
# features 0, 128, 256 ... of the made-up picture, and of all of them the mean and the length
RECORDED = [
    0.0, 0.01098395, 0.27706271, 2.342e-05, 0.00695335, 0.0801452, 0.07030886, 0.0,
    0.00166372, 6.149e-05, 0.00030654, 0.00209429, 0.06294659, 0.03155219, 0.17736709, 0.09985511,
]  # fmt: skip
RECORDED_MEAN, RECORDED_NORM = 0.06466031689326224, 4.985941402857821


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    with torch.device("meta"):
        blank = Inception().state_dict()
    return fill(blank, GAIN)


@pytest.fixture(scope="module")
def network(weights) -> Inception:
    ours = Inception()
    ours.load_state_dict(weights)
    return ours.eval()


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    return torch.from_numpy(np.floor(256 * unit("picture", 3 * 97 * 211)).astype(np.uint8).reshape(1, 3, 97, 211))


@pytest.mark.parity
def test_features_are_those_that_torch_fidelity_gave(network, images):
    with torch.inference_mode():
        features = network(images)[0].double()
    assert features.shape == (2048,)
    assert features[::128].tolist() == pytest.approx(RECORDED, abs=1e-6)
    assert float(features.mean()) == pytest.approx(RECORDED_MEAN, rel=1e-6)
    assert float(features.norm()) == pytest.approx(RECORDED_NORM, rel=1e-6)


@pytest.mark.needs(os.environ.get("TORCH_FIDELITY"), "torch-fidelity: TORCH_FIDELITY names the folder it is in")
@pytest.mark.parity
def test_features_are_those_of_torch_fidelity(network, weights, tmp_path):
    torch.save(weights, tmp_path / "weights.pth")
    theirs = fidelity_inception(tmp_path / "weights.pth")
    images = torch.randint(256, (2, 3, 120, 330), dtype=torch.uint8)
    with torch.inference_mode():
        ours, (recorded,) = network(images), theirs(images)
    assert float((ours - recorded).abs().max()) < 1e-5 * float(recorded.abs().max())


def test_resizing_worked_by_hand():
    x = torch.tensor([[0.0, 8.0, 4.0]]).view(1, 1, 1, 3).expand(1, 1, 2, 3)
    # pixel i of 4 looks at 0.75 i: 0, 0.75, 1.5, 2.25 (beyond the last: the last)
    assert resized(x, 4)[0, 0, 3].tolist() == [0, 6, 6, 4]
    rows = resized(torch.tensor([0.0, 8.0]).view(1, 1, 2, 1), 4)[0, 0, :, 0]
    assert rows.tolist() == [0, 4, 8, 8]


def test_the_batch_is_each_image_alone(network):
    images = torch.randint(256, (2, 3, 80, 90), dtype=torch.uint8)
    with torch.inference_mode():
        together, alone = network(images), torch.cat([network(images[:1]), network(images[1:])])
    assert torch.allclose(together, alone, atol=1e-5)


# --- the file -------------------------------------------------------------------------------------------------------


def written(path, content) -> str:
    """Write a weight file; return its SHA-256."""
    torch.save(content, path)
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_file_is_loaded_whole(tmp_path, weights, network, images):
    path = tmp_path / "inception.pth"
    # some files have no counters; `network` was filled from a table with them
    sha256 = written(path, {key: value for key, value in weights.items() if "num_batches" not in key})
    loaded = load_inception(path, sha256=sha256)
    assert not loaded.training
    with torch.inference_mode():
        assert torch.equal(loaded(images), network(images))


def test_another_file_is_refused(tmp_path):
    path = tmp_path / "inception.pth"
    written(path, {"fc.bias": torch.zeros(3)})
    with pytest.raises(InputError, match=r"inception\.pth: is not the published file .*https://github.com/mseitzer"):
        load_inception(path)


def test_the_file_is_looked_for_in_the_cache_and_never_fetched(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    assert find_inception() is None
    cached = tmp_path / "checkpoints" / inception.FILE_NAMES[1]
    cached.parent.mkdir()
    cached.touch()
    assert find_inception() == cached
    given = tmp_path / "given.pth"
    with pytest.raises(InputError, match=r"given\.pth: no such file; FID needs the weights"):
        find_inception(given)
    given.touch()
    assert find_inception(given) == given
