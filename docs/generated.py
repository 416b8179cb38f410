"""A hook of mkdocs: writes the parts of the site that the program itself knows, so that no page repeats them by hand.

A page holds `<!-- generated: NAME -->` where the Markdown of PARTS[NAME] belongs. Pages of the repository's root
(changelog, contributing, ...) become pages of the site. Pages that load anything from elsewhere are warned about.
"""

from __future__ import annotations

import ast
import inspect
import logging
import re
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "src" / "lidar2pano"
REPOSITORY = "https://github.com/lidar2pano/lidar2pano/blob/main"
ROOT_PAGES = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "CONVENTIONS.md": "conventions.md",
    "RESULTS.md": "results.md",
    "SECURITY.md": "security.md",
    "CODE_OF_CONDUCT.md": "code_of_conduct.md",
}
MARKER = re.compile(r"<!-- generated: (\S+) -->")
LINK = re.compile(r"(?<=\]\()(?!https?:|#|mailto:)([^)#\s]+)")
OUTSIDE = re.compile(
    r'<(?:script|img|iframe)\b[^>]*\bsrc="https?:|<link\b(?=[^>]*\brel="stylesheet")[^>]*\bhref="https?:'
)
MIB = 2**20

log = logging.getLogger("mkdocs.hooks.generated")


# --- what mkdocs calls ----------------------------------------------------------------------------------------------


def on_files(files: Any, config: Any) -> Any:  # noqa: ANN401
    """Add the pages that lie at the repository's root."""
    from mkdocs.structure.files import File

    for source, page in ROOT_PAGES.items():
        text = site_links((ROOT / source).read_text(encoding="utf-8"))
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Fill in the generated parts of a page."""
    return fill(markdown)


def on_post_page(output: str, page: Any, **_: object) -> str:  # noqa: ANN401
    """Warn where a page would load something from elsewhere: the site works without a network."""
    if found := OUTSIDE.search(output):
        log.warning("%s loads something from elsewhere: %s", page.file.src_path, found[0])
    return output


def fill(markdown: str) -> str:
    """The text with every marker replaced by its part; a KeyError names a marker without one."""
    return MARKER.sub(lambda found: PARTS[found[1]](), markdown)


def site_links(text: str) -> str:
    """A root page's relative links as the site has them; files that the site lacks are linked in the repository."""

    def moved(found: re.Match[str]) -> str:
        target = found[1]
        if target in ROOT_PAGES:
            return ROOT_PAGES[target]
        return target.removeprefix("docs/") if target.startswith("docs/") else f"{REPOSITORY}/{target}"

    return LINK.sub(moved, text)


# --- tables ---------------------------------------------------------------------------------------------------------


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(_cell(value) for value in line)} |" for line in lines)


def _cell(value: object) -> str:
    return str(value).replace("|", "\\|").replace("\n", " ")


def _prose(text: str | None) -> str:
    """A help text as Markdown: "<stem>" is no tag."""
    return inspect.cleandoc(text or "").replace("<", "&lt;")


def _first(text: str | None) -> str:
    """The first paragraph of a docstring."""
    return " ".join(inspect.cleandoc(text or "").split("\n\n")[0].split())


# --- the command line -----------------------------------------------------------------------------------------------


def commands() -> Iterator[tuple[str, Any]]:
    """(name, click command) of every command, groups before their members."""
    from typer.main import get_command

    from lidar2pano.cli import app

    def walk(words: str, command: Any) -> Iterator[tuple[str, Any]]:  # noqa: ANN401
        if words:
            yield words, command
        for name, inner in getattr(command, "commands", {}).items():
            yield from walk(f"{words} {name}".strip(), inner)

    yield from walk("", get_command(app))


def command_line() -> str:
    """Every command with its arguments and options, from the program's own declarations."""
    return "\n\n".join(_command(name, command) for name, command in commands())


def _command(name: str, command: Any) -> str:  # noqa: ANN401
    arguments = [one for one in command.params if one.param_type_name == "argument"]
    options = [one for one in command.params if one.param_type_name != "argument" and "--help" not in one.opts]
    usage = " ".join(["lidar2pano", name, *["[OPTIONS]"] * bool(options), *(_metavar(one) for one in arguments)])
    parts = [f"## {name}", _prose(command.help)]
    if not hasattr(command, "commands"):
        parts.append(f"```sh\n{usage}\n```")
    if arguments:
        parts.append(table(["argument", "meaning"], ((f"`{_metavar(one)}`", _prose(one.help)) for one in arguments)))
    if options:
        rows = ((f"`{_flags(one)}`", _prose(one.help), _default(one)) for one in options)
        parts.append(table(["option", "meaning", "default"], rows))
    return "\n\n".join(parts)


def _metavar(parameter: Any) -> str:  # noqa: ANN401
    return parameter.metavar or parameter.human_readable_name


def _flags(option: Any) -> str:  # noqa: ANN401
    flags = ", ".join(option.opts)
    return flags if option.is_flag else f"{flags} {_metavar(option) if option.metavar else option.type.name.upper()}"


def _default(option: Any) -> str:  # noqa: ANN401
    if option.required:
        return "required"
    value = option.default
    return "" if value is None or value in ("", [], ()) or option.is_flag else f"`{value}`"


# --- the rest of the program ----------------------------------------------------------------------------------------


def api() -> str:
    """A section of mkdocstrings for every public name."""
    import lidar2pano

    names = [name for name in lidar2pano.__all__ if not name.startswith("_")]
    functions = [name for name in names if inspect.isroutine(getattr(lidar2pano, name))]
    classes = [name for name in names if inspect.isclass(getattr(lidar2pano, name))]
    tables = [name for name in names if name not in {*functions, *classes}]
    groups = {"Functions": functions, "Classes": classes, "Tables": tables}
    return "\n\n".join(
        f"## {title}\n\n" + "\n\n".join(f"::: lidar2pano.{name}" for name in group) for title, group in groups.items()
    )


def recipes() -> str:
    """Every recipe: its name, what it trains, on which raster, and what its docstring says."""
    from lidar2pano.train.recipes import RECIPES

    def row(name: str) -> list[str]:
        recipe = RECIPES[name]()
        networks = ", ".join(f"`{network.model}`" for network in recipe.networks.values())
        training = recipe.training
        limit = f"{training.epochs:g} epochs" if training.epochs else f"{training.steps} steps"
        limit = f"{training.minutes:g} min" if training.minutes else limit
        return [
            f"`{name}`",
            _first(RECIPES[name].__doc__) or _variant(name, set(RECIPES)),
            networks,
            f"{limit}, batch {recipe.training.batch}",
        ]

    return table(["recipe", "what it is", "networks", "length"], map(row, RECIPES))


def _variant(name: str, known: set[str]) -> str:
    """What a recipe without a docstring is: the small form of another, or another with a part left out."""
    if name.removesuffix("-mini") in known - {name}:
        return f"`{name.removesuffix('-mini')}` for two CPU cores."
    base, _, without = name.partition("-no-")
    return f"`{base}` without {without}, the paper's ablation." if without and base in known else ""


def paper_rows() -> str:
    """Every row of the paper's tables: the recipes behind it, and the command that makes it."""
    from lidar2pano.reproduce.plan import ROWS

    def row(name: str) -> list[str]:
        parts = " + ".join(f"`{part}`" for part in ROWS[name].parts)
        origin = ROWS[name].source if ROWS[name].paper or ROWS[name].miou is not None else "ours, beside it"
        return [ROWS[name].name, "1, 2" if ROWS[name].segments else "2", origin, parts, f"`--rows {name}`"]

    return table(["row", "tables", "from", "recipes", "option of `reproduce`"], map(row, ROWS))


def views() -> str:
    """The table of rasters."""
    from lidar2pano import VIEWS

    rows = (
        [f"`{name}`", f"{view.rows} x {view.columns}", view.kind, f"{view.up:g} to {view.down:g}"]
        + [f"{view.left:g} to {view.right:g}"]
        for name, view in VIEWS.items()
    )
    return table(["view", "rows x columns", "form", "elevation: degrees (sphere), tangent (cylinder)", "azimuth"], rows)


def classes() -> str:
    """Ids, names and colours of the 15 classes of the panorama, and the classes of SemanticKITTI with their raw ids."""
    from lidar2pano import CITYSCAPES, COMMON15, SEMANTIC_KITTI

    parts = []
    for labels in (COMMON15, SEMANTIC_KITTI, CITYSCAPES):
        raw = labels.raw or range(len(labels))
        rows = (
            [index, name, value, f'<span style="background: rgb{colour}">&emsp;&emsp;</span>']
            for index, (name, value, colour) in enumerate(zip(labels.classes, raw, labels.colours, strict=True))
        )
        parts.append(f"### {labels.name}\n\n{table(['id', 'class', 'id in files', 'colour'], rows)}")
    return "\n\n".join(parts)


def released() -> str:
    """The released families, from the cards of their files."""
    from lidar2pano.models.card import read_card
    from lidar2pano.models.families import families

    def row(family: str, file: Path) -> list[str]:
        card = read_card(file)
        size = f"{file.stat().st_size / MIB:.1f} MiB"
        return [f"`{family}`", file.stem, f"`{card.network}`", size, str(card.licence), f"{card.hours} h"]

    rows = (row(name, file) for name, folder in families().items() for file in sorted(folder.glob("*.safetensors")))
    return table(["family", "part", "network", "size", "licence", "trained for"], rows)


def published() -> str:
    """Networks whose published weights can be imported, where they are and on which terms."""
    from lidar2pano.models.published import PUBLISHED

    rows = ([f"`{name}`", f"<{one.upstream}>", one.licence] for name, one in PUBLISHED.items())
    return table(["network", "published at", "licence, as stated there"], rows)


def extras() -> str:
    """The optional dependencies, from pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    rows = ([f"`{name}`", ", ".join(wanted)] for name, wanted in project["optional-dependencies"].items())
    return table(["extra", "packages"], rows)


# --- messages -------------------------------------------------------------------------------------------------------

GAP = "…"  # stands in a message for what differs from case to case


def messages(source: Path = SOURCE) -> dict[str, str]:
    """Every message that the code raises an InputError with: text, with GAP for values -> the module."""
    found: dict[str, str] = {}
    for path in sorted(source.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "InputError" and node.args:
                text = re.sub(f"{GAP}+", GAP, _template(node.args[0]))
                if len(text.replace(GAP, "")) > len(": ;"):
                    found.setdefault(text, path.relative_to(source).as_posix())
    return found


def texts(source: Path = SOURCE) -> set[str]:
    """Every text in the code, with GAP for values: what the program can print."""
    return {
        _template(node)
        for path in source.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant | ast.JoinedStr | ast.BinOp)
    }


def _template(node: ast.expr) -> str:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(_template(part) for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _template(node.left) + _template(node.right)
    return GAP


def message_index() -> str:
    """All messages, by the part of the package that raises them."""
    groups: dict[str, list[str]] = {}
    for text, module in messages().items():
        groups.setdefault(module.partition("/")[0].removesuffix(".py"), []).append(text)
    return "\n\n".join(
        f"## {group}\n\n" + "\n".join(f"- `{text}`" for text in sorted(texts)) for group, texts in groups.items()
    )


def quoted(page: str) -> list[str]:
    """The messages that the troubleshooting page quotes: its third-level headings in backticks."""
    return re.findall(r"^### `(.+)`$", page, flags=re.MULTILINE)


PARTS = {
    "commands": command_line,
    "api": api,
    "recipes": recipes,
    "paper-rows": paper_rows,
    "views": views,
    "classes": classes,
    "released": released,
    "published": published,
    "extras": extras,
    "messages": message_index,
}
