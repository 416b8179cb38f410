"""A look that is added to a scene painter: those that it knows stay as they are."""

from __future__ import annotations

import pytest
import torch

from lidar2pano.errors import InputError
from lidar2pano.models import build
from lidar2pano.models.added_look import train_last_look, with_look
from lidar2pano.models.scene_painter import framed

SETTINGS = {"looks": ["day", "rain"], "look": "rain", "widths": [8, 12, 16, 8], "class_colours": True, "glass": True}


@pytest.fixture
def painter():
    torch.manual_seed(0)
    network = build("scene-painter", **SETTINGS).eval()
    torch.nn.init.normal_(network.class_colours.weight)
    torch.nn.init.normal_(network.glass.weight)
    return network


@pytest.fixture
def inputs(painter):
    channels = painter.stem[0].weight.shape[1]
    return framed(torch.rand(1, channels, 16, 32), torch.rand(1, 3, 32, 64))


def painted(painter, inputs, look: str) -> torch.Tensor:
    return painter(*inputs, torch.tensor([painter.look_shares(look)]), torch.full((1, 3), 0.1))


def test_the_new_look_begins_as_the_painters_own_and_changes_no_other(painter, inputs):
    wider, settings = with_look(painter, SETTINGS, "snow")
    wider.eval()
    assert wider.looks == ("day", "rain", "snow") and wider.look == "snow"
    before = {look: painted(painter, inputs, look) for look in ("day", "rain", "day+rain")}
    assert torch.allclose(painted(wider, inputs, "snow"), before["rain"], atol=1e-5)
    train_last_look(wider)
    optimizer = torch.optim.Adam([weight for weight in wider.parameters() if weight.requires_grad], 0.05)
    for _ in range(3):
        optimizer.zero_grad()
        painted(wider, inputs, "snow").mean().backward()
        optimizer.step()
    assert (painted(wider, inputs, "snow") - before["rain"]).abs().max() > 0.01
    for look, image in before.items():
        assert torch.allclose(painted(wider, inputs, look), image, atol=1e-5), look
    again = build("scene-painter", **settings).eval()
    again.load_state_dict(wider.state_dict())
    assert torch.equal(painted(again, inputs, "snow"), painted(wider, inputs, "snow"))


def test_a_second_look_is_added_beside_the_first(painter, inputs):
    first, settings = with_look(painter, SETTINGS, "snow")
    second, _ = with_look(first, settings, "fog")
    assert second.eval().looks == ("day", "rain", "snow", "fog")
    assert torch.allclose(painted(second, inputs, "fog"), painted(painter, inputs, "rain"), atol=1e-5)


@pytest.mark.parametrize(
    ("name", "reason"), [("day", "has a look 'day' already"), ("", "needs a name"), ("a+b", "needs")]
)
def test_names_that_none_can_have_are_refused(painter, name, reason):
    with pytest.raises(InputError, match=reason):
        with_look(painter, SETTINGS, name)
