"""Families of weights in folders and on the hub, in the form of huggingface_hub's mixin, and their pages."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import TypedDict

from lidar2pano.bounded_files import name_of_open, open_regular
from lidar2pano.errors import InputError
from lidar2pano.formats.image_files import write_text, write_whole
from lidar2pano.markdown import front_matter
from lidar2pano.models.card import SCORES, Card, read_card, write_scores
from lidar2pano.models.families import families

LICENCES = (
    "apache-2.0",
    "mit",
    "bsd-3-clause",
    "cc0-1.0",
    *(f"cc-by-{kind}4.0" for kind in ("", "sa-", "nc-", "nc-sa-")),
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
REPOSITORY = re.compile(r"[\w.-]+/[\w.-]+")
FETCHED = ["*.safetensors", SCORES, "LICENSE*", "README.md"]  # nothing else of a repository: no pickles, no programs
PAGE = "README.md"


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


class Upload(TypedDict, total=False):
    """Keywords of an upload, as of huggingface_hub's mixin."""

    commit_message: str
    private: bool | None
    token: str | None
    branch: str | None
    create_pr: bool | None
    allow_patterns: list[str] | str | None
    ignore_patterns: list[str] | str | None
    delete_patterns: list[str] | str | None


def hub_folder(  # noqa: PLR0917 the mixin's keywords
    name: str | Path,
    revision: str | None = None,
    cache_dir: str | Path | None = None,
    force_download: bool = False,
    token: str | bool | None = None,
    local_files_only: bool = False,
) -> str | Path:
    """Return a folder with the files of a repository "owner/name"; a folder, file or family remains as it is.

    Raises InputError without huggingface_hub or a network, and for a repository that cannot be had.
    """
    if str(name) in families() or Path(name).exists() or not REPOSITORY.fullmatch(str(name)):
        return name
    hub = _hub(f"{name}: no such folder, and the hub needs a library")
    try:
        return hub.snapshot_download(
            str(name),
            revision=revision,
            cache_dir=cache_dir,
            force_download=force_download,
            token=token,
            local_files_only=local_files_only,
            allow_patterns=FETCHED,
            library_name="lidar2pano",
        )
    except Exception as error:  # each of its versions has other classes, of other HTTP libraries
        raise InputError(f"{name}: cannot be fetched from the hub ({_reason(error)}); give a folder") from None


def write_family(folder: Path, files: Mapping[str, Path], cards: Mapping[str, Card]) -> None:
    """Write weight files by role, their LICENSE, scores and page into a folder; a page that is there stays.

    cards  as they were when the files were read. Raises InputError where a file is another by now, the folder holds
    other weights, and where it cannot be written.
    """
    if not files:
        raise InputError(f"{folder}: this pipeline was not loaded from weight files; load() one that is")
    names = {role: f"{role.replace(' ', '-')}.safetensors" for role in files}
    if strangers := sorted({file.name for file in folder.glob("*.safetensors")} - set(names.values())):
        raise InputError(f"{folder}: holds other weights ({strangers[0]}); choose another folder")
    every_card = {role: read_card(file) for role, file in files.items()}
    if changed := [role for role, card in cards.items() if role in files and card != every_card[role]]:
        raise InputError(f"{files[changed[0]]}: has changed since it was loaded; load it again")
    licences = dict(_licences(files))
    for name, source in [(names[role], file) for role, file in files.items()] + list(licences.items()):
        write_whole(folder / name, lambda part, source=source: _copy(source, part), "folder")
    if any(card.score for card in every_card.values()):
        write_scores(folder, every_card.values())
    if not (folder / PAGE).exists():
        text = model_page(folder.resolve().name, every_card)
        write_text(folder / PAGE, text, "folder")


def push_family(repo_id: str, files: Mapping[str, Path], cards: Mapping[str, Card], upload: Upload) -> str:
    """Upload the files of `write_family` to a repository of the hub; a missing repository is made.

    Returns the address of the commit. Raises InputError as `write_family`, without huggingface_hub or a network, and
    where the hub refuses.
    """
    hub = _hub(f"{repo_id}: uploading needs a library")
    options = {"commit_message": "Push model using huggingface_hub.", **upload}
    private, token, branch = (options.pop(key, None) for key in ("private", "token", "branch"))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / Path(repo_id).name
        write_family(folder, files, cards)
        try:
            api = hub.HfApi(token=token)
            name = api.create_repo(repo_id, private=private, exist_ok=True).repo_id
            commit = api.upload_folder(repo_id=name, repo_type="model", folder_path=folder, revision=branch, **options)
        except Exception as error:  # see hub_folder
            mend = "save_pretrained(folder) writes the same files"
            raise InputError(f"{repo_id}: cannot be uploaded to the hub ({_reason(error)}); {mend}") from None
    return str(commit)


def _hub(fault: str) -> ModuleType:
    try:
        import huggingface_hub
    except ModuleNotFoundError:
        raise InputError(f"{fault}: pip install 'lidar2pano[train]'; or give a folder") from None
    return huggingface_hub


def _reason(error: Exception) -> str:
    lines = [line.strip().rstrip(".") for line in str(error).splitlines() if line.strip()]
    return ", ".join(lines[:2]) or type(error).__name__


def _licences(files: Mapping[str, Path]) -> Iterator[tuple[str, Path]]:
    """Yield names and files of the licences beside weight files; those of several folders are named by their roles."""
    folders: dict[Path, list[str]] = {}
    for role, file in files.items():
        folders.setdefault(file.parent, []).append(role.replace(" ", "-"))
    for folder, roles in folders.items():
        if (folder / "LICENSE").is_file():
            yield "LICENSE" if len(folders) == 1 else f"LICENSE-{'-'.join(roles)}", folder / "LICENSE"


def _copy(source: Path, target: Path) -> None:
    with open_regular(source) as file:
        shutil.copyfile(name_of_open(file), target)
