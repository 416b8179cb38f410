"""lidar2pano weights list, info, import."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidar2pano.cli.app import app
from lidar2pano.errors import InputError

if TYPE_CHECKING:
    from lidar2pano.models.card import Card

MIB = 1 << 20
weights = typer.Typer()
app.add_typer(weights, name="weights", help="Installed weights; the card of a weight file; import of published ones.")


@weights.command("list")
def list_families() -> None:
    """List the installed families: networks, size, licence, score."""
    from lidar2pano.models.card import read_card
    from lidar2pano.models.families import best_family, families, role

    installed, default = families(), best_family()
    for name, folder in installed.items():
        files = sorted(folder.glob("*.safetensors"))
        cards = [read_card(file) for file in files]
        size = sum(file.stat().st_size for file in files) / MIB
        licences = ", ".join(sorted({card.licence or "not stated" for card in cards}))
        print(f"{name}{' (default)' if name == default else ''}  {size:.1f} MiB  licence {licences}")
        for file, card in zip(files, cards, strict=True):
            score = ", ".join(f"{name} {short(value)}" for name, value in card.score.items())
            line = f"  {role(card) or 'no role'}: {card.network}, {file.stat().st_size / MIB:.1f} MiB  {score}"
            print(line.rstrip())


@weights.command("info")
def info(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A family, a run's folder or a weight file.")],
) -> None:
    """Show the origin of weights: all of their cards."""
    from lidar2pano.models.card import read_card
    from lidar2pano.models.families import families, weight_files

    path = Path(name)
    files = [path] if name not in families() and path.is_file() else weight_files(name, fill=False).values()
    for file in files:
        print(f"{file}  {file.stat().st_size / MIB:.1f} MiB")
        print(*(f"  {line}" for line in lines_of(read_card(file))), sep="\n")


@weights.command("import")
def import_files(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE", help="Checkpoint as its authors published it; vid2vid: one per scale, or a folder."
        ),
    ],
    network: Annotated[
        str,
        typer.Option(
            "--as",
            metavar="NETWORK",
            help="salsanext, titan, titan-critic, sdnet, vid2vid, vid2vid-single, vid2vid-image-critic,"
            " vid2vid-temporal-critic, pix2pix or pix2pix-critic.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The weight file to write (NETWORK.safetensors).")
    ] = None,
) -> None:
    """Turn a published checkpoint into a weight file; nothing in it is executed, every tensor must fit."""
    import torch

    from lidar2pano.cli.options import check_file
    from lidar2pano.models import build
    from lidar2pano.models.card import save
    from lidar2pano.models.published import import_published, published_card

    target = out or Path(f"{network}.safetensors")
    check_file(target, "--out")
    if target.exists():
        raise InputError(f"{target}: exists already; remove it or choose another --out")
    settings, state = import_published(files, network)
    with torch.device("meta"):  # the largest have 1.6 GiB: once is enough
        model = build(network, **settings)
    model.load_state_dict(state, assign=True)
    card = published_card(network, ", ".join(file.name for file in files), settings)
    try:
        card = save(target, model, card, dtype=torch.float32)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror or error}); choose another --out") from error
    except ValueError as error:
        raise InputError(f"{', '.join(map(str, files))}: {error}; give another checkpoint") from error
    print(f"{target}: {card.network}, licence: {card.licence}")


def lines_of(card: Card) -> list[str]:
    """Return a card for people: one line per field with a value."""
    from dataclasses import asdict

    lines = []
    for name, value in asdict(card).items():
        if value in ("", None, {}, 0):
            continue
        parts = [f"{key} {short(part)}" for key, part in value.items()] if isinstance(value, dict) else [short(value)]
        if name == "views":
            parts = [f"{role}: {view_line(view)}" for role, view in value.items()]
        lines.append(f"{name:<14}{', '.join(parts)}")
    return lines


def view_line(view: dict[str, Any]) -> str:
    """Return a view of a card on one line."""
    rest = (f"{name}={short(value)}" for name, value in view.items() if name not in ("rows", "columns"))
    return " ".join([f"{view.get('rows')} x {view.get('columns')}", *rest])


def short(value: object) -> str:
    """Return numbers with few digits, lists with few spaces."""
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"[{' '.join(short(part) for part in value)}]" if isinstance(value, list | tuple) else str(value)
