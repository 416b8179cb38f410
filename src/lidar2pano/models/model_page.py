"""The page of a family of weights (README.md): the header that model hubs read, its networks, scores and use."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from lidar2pano.formats.json_files import front_matter
from lidar2pano.models.card import Card

LICENCES = (
    "apache-2.0",
    "mit",
    "bsd-3-clause",
    "cc0-1.0",
    "cc-by-4.0",
    "cc-by-sa-4.0",
    "cc-by-nc-4.0",
    "cc-by-nc-sa-4.0",
)
"""Licences by the hub's names, which are SPDX's in small letters; others are "other", with their own words."""
SECTORS = ("camera", "panorama", "point")  # first words of scores
METRICS = {"miou": "mean_iou", "accuracy": "accuracy", "ssim": "ssim", "swd": "swd", "depth_abs_rel": "abs_rel"}
TAGS = ("lidar", "panorama", "point-cloud", "semantic-segmentation", "depth-estimation", "image-generation")
USE = """\
One LiDAR scan in, a 360-degree colour panorama out, with classes and depth. Classes and depth come from the points and
the networks; colours are invented where no camera sees.

```python
from lidar2pano import Pipeline

pipeline = Pipeline.from_pretrained("{name}")  # this folder, or "owner/name" on the hub
pipeline("scan.bin").save("panoramas")
```
"""


def model_page(name: str, cards: Mapping[str, Card]) -> str:
    """Return the page of a family: Markdown with a YAML header.

    cards  by role. Licence, data and scores are theirs.
    """
    header = {
        **hub_licence(card.licence for card in cards.values()),
        "library_name": "lidar2pano",
        "tags": list(TAGS),
        "datasets": sorted({part for card in cards.values() for part in card.data.split("+") if part}),
        "metrics": sorted({METRICS[metric] for card in cards.values() for _, metric, _ in scores(card)}),
    }
    rows = [
        f"| {role} | `{card.network}` | {card.data or '-'} | {card.steps or '-'} | {score_cell(card)} |"
        for role, card in sorted(cards.items())
    ]
    licences = ", ".join(sorted({card.licence or "not stated" for card in cards.values()}))
    return "\n".join(
        [
            front_matter({key: value for key, value in header.items() if value}),
            f"# {name}\n",
            USE.format(name=name),
            "| part | network | trained on | steps | scores |",
            "| --- | --- | --- | ---: | --- |",
            *rows,
            f"\nLicence of the weights: {licences}.",
            "Files are safetensors with a card each; they are loaded strictly, and nothing in them is executed.\n",
        ]
    )


def hub_licence(licences: Iterable[str]) -> dict[str, str]:
    """Return the hub's fields of a licence: its own name for one that it knows, else "other" and the words."""
    stated = sorted({licence or "not stated" for licence in licences})
    if len(stated) == 1 and stated[0].lower() in LICENCES:
        return {"license": stated[0].lower()}
    return {"license": "other", "license_name": "; ".join(stated)}


def scores(card: Card) -> Iterator[tuple[str, str, float]]:
    """Yield sector ("" where it is not said), metric and value of the card's scores with a name in METRICS."""
    for key, value in card.score.items():
        first, _, rest = key.partition("_")
        sector, metric = (first, rest) if first in SECTORS else ("", key)
        if metric in METRICS and isinstance(value, int | float):
            yield sector, metric, value


def score_cell(card: Card) -> str:
    """Return the card's scores on one line, with the split that they were measured on."""
    values = [f"{sector} {metric} {value:.3g}".strip() for sector, metric, value in scores(card)]
    split = f" (split `{card.score['split']}`)" if values and "split" in card.score else ""
    return (", ".join(values) or "-") + split
