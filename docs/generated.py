"""Parts of pages that come from the program itself, and a hook of mkdocs.

Run this file (`make generated`) to write PARTS[NAME] between `<!-- generated: NAME -->` and `<!-- end of generated -->`
of every page, so that pages can be read on a repository host as well; a test compares them. For the site, links to
files outside docs/ become links to the site's pages or to the repository, and the API page is made by mkdocstrings.
A page with a resource from elsewhere causes a warning.
"""

from __future__ import annotations

import ast
import inspect
import logging
import os
import re
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
SOURCE = ROOT / "src" / "lidar2pano"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
REPOSITORY = f"{PROJECT['urls']['Homepage']}/blob/main"
ROOT_PAGES = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "CONVENTIONS.md": "conventions.md",
    "RESULTS.md": "results.md",
    "SECURITY.md": "security.md",
    "CODE_OF_CONDUCT.md": "code_of_conduct.md",
}
PART = re.compile(r"(<!-- generated: (\S+) -->\n).*?(<!-- end of generated -->)", re.DOTALL)
LINK = re.compile(r"(?<=\]\()(?!https?:|#|mailto:)([^)#\s]+)")
OUTSIDE = re.compile(
    r'<(?:script|img|iframe)\b[^>]*\bsrc="https?:|<link\b(?=[^>]*\brel="stylesheet")[^>]*\bhref="https?:'
)
MIB = 2**20

log = logging.getLogger("mkdocs.hooks.generated")


# --- the hooks of mkdocs ---------------------------------------------------------------------------------------------


def on_files(files: Any, config: Any) -> Any:  # noqa: ANN401
    """Add the pages of the repository's root."""
    from mkdocs.structure.files import File

    for source, page in ROOT_PAGES.items():
        text = site_links((ROOT / source).read_text(encoding="utf-8"), ROOT)
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: object) -> str:  # noqa: ANN401
    """Link to pages of the site, and have mkdocstrings make the API page."""
    place = page.file.src_uri
    if place in ROOT_PAGES.values():
        return markdown
    return site_links(fill(markdown, {"api": api_directives}), (DOCS / place).parent)


def on_post_page(output: str, page: Any, **_: object) -> str:  # noqa: ANN401
    """Warn of a page with a resource from elsewhere: the site works without a network."""
    if match := OUTSIDE.search(output):
        log.warning("%s loads something from elsewhere: %s", page.file.src_path, match[0])
    return output


def fill(markdown: str, parts: Mapping[str, Callable[[], str]]) -> str:
    """Return a page with new content in those of its generated parts that have a function here."""
    return PART.sub(
        lambda match: f"{match[1]}\n{parts[match[2]]()}\n\n{match[3]}" if match[2] in parts else match[0], markdown
    )


def site_links(text: str, folder: Path) -> str:
    """Rewrite a page's links to files outside docs/: to pages of the site, or else into the repository.

    folder  of the page, which its links start from; pages of the repository's root lie in docs/ on the site.
    """
    on_site = DOCS if folder == ROOT else folder

    def moved(match: re.Match[str]) -> str:
        target = Path(os.path.normpath(folder / match[1]))
        inside = DOCS / ROOT_PAGES[target.name] if target.parent == ROOT and target.name in ROOT_PAGES else target
        if inside.is_relative_to(DOCS):
            return os.path.relpath(inside, on_site)
        return f"{REPOSITORY}/{target.relative_to(ROOT).as_posix()}"

    return LINK.sub(moved, text)


def write_parts() -> list[Path]:
    """Write the generated parts into all pages; returns the pages that have changed."""
    changed = []
    for page in sorted(DOCS.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        if (filled := fill(text, PARTS)) != text:
            page.write_text(filled, encoding="utf-8")
            changed.append(page)
    return changed


# --- tables ---------------------------------------------------------------------------------------------------------


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(_cell(value) for value in line)} |" for line in lines)


def _cell(value: object) -> str:
    return str(value).replace("|", "\\|").replace("\n", " ")


def _prose(text: str | None) -> str:
    """Return a help text as Markdown: "<stem>" is no tag."""
    return inspect.cleandoc(text or "").replace("<", "&lt;")


def _first(text: str | None) -> str:
    """Return the first paragraph of a docstring."""
    return " ".join(inspect.cleandoc(text or "").split("\n\n")[0].split())


# --- the command line -----------------------------------------------------------------------------------------------


def commands() -> Iterator[tuple[str, Any]]:
    """Yield (name, click command) of every command, groups first."""
    from lidar2pano.cli.app import make_program

    def walk(words: str, command: Any) -> Iterator[tuple[str, Any]]:  # noqa: ANN401
        if words:
            yield words, command
        for name, inner in getattr(command, "commands", {}).items():
            yield from walk(f"{words} {name}".strip(), inner)

    yield from walk("", make_program())


def command_line() -> str:
    """Describe every command with its arguments and options, from the program's own declarations."""
    return "\n\n".join(_command(name, command) for name, command in commands())


def _command(name: str, command: Any) -> str:  # noqa: ANN401
    arguments = [item for item in command.params if item.param_type_name == "argument"]
    options = [item for item in command.params if item.param_type_name != "argument" and "--help" not in item.opts]
    usage = " ".join(["lidar2pano", name, *["[OPTIONS]"] * bool(options), *map(_metavar, arguments)])
    parts = [f"## {name}", _prose(command.help)]
    if not hasattr(command, "commands"):
        parts.append(f"```sh\n{usage}\n```")
    if arguments:
        parts.append(table(["argument", "meaning"], ((f"`{_metavar(item)}`", _prose(item.help)) for item in arguments)))
    if options:
        rows = ((f"`{_flags(item)}`", _prose(item.help), _default(item)) for item in options)
        parts.append(table(["option", "meaning", "default"], rows))
    return "\n\n".join(parts)


def _metavar(parameter: Any) -> str:  # noqa: ANN401
    name = parameter.metavar or parameter.human_readable_name
    return f"{name}..." if parameter.nargs == -1 else name


def _flags(option: Any) -> str:  # noqa: ANN401
    flags = ", ".join(option.opts)
    return flags if option.is_flag else f"{flags} {_metavar(option) if option.metavar else option.type.name.upper()}"


def _default(option: Any) -> str:  # noqa: ANN401
    if option.required:
        return "required"
    value = option.default
    return "" if value is None or value in ("", [], ()) or option.is_flag else f"`{value}`"


# --- the rest of the program ----------------------------------------------------------------------------------------


def public_groups() -> dict[str, list[str]]:
    """Return the public names by kind."""
    import lidar2pano

    names = [name for name in lidar2pano.__all__ if not name.startswith("_")]
    functions = [name for name in names if inspect.isroutine(getattr(lidar2pano, name))]
    classes = [name for name in names if inspect.isclass(getattr(lidar2pano, name))]
    tables = [name for name in names if name not in {*functions, *classes}]
    return {"Functions": functions, "Classes": classes, "Tables": tables}


def api_directives() -> str:
    """Return a section of mkdocstrings for every public name."""
    return "\n\n".join(
        f"## {title}\n\n" + "\n\n".join(f"::: lidar2pano.{name}" for name in group)
        for title, group in public_groups().items()
    )


def api() -> str:
    """Return signature and docstring of every public name, and of the methods of classes."""
    import lidar2pano

    sections = []
    for title, group in public_groups().items():
        parts = "\n\n".join(_described(name, getattr(lidar2pano, name)) for name in group)
        sections.append(f"## {title}\n\n{parts}")
    return "\n\n".join(sections)


def _described(name: str, value: object) -> str:
    if not inspect.isroutine(value) and not inspect.isclass(value):
        return f"- `{name}`: a {type(value).__name__}"
    members = [
        f"- `{member}{_signature(function)}`: {_first(function.__doc__)}"
        for member, function in vars(value).items()
        if inspect.isclass(value) and inspect.isfunction(function) and (member == "__call__" or member[0] != "_")
    ]
    text = f"### {name}\n\n```text\n{name}{_signature(value)}\n```\n\n```text\n{inspect.getdoc(value)}\n```"
    return "\n\n".join([text, *(["\n".join(members)] if members else [])])


def _signature(value: object) -> str:
    try:
        signature = inspect.signature(value)  # type: ignore[arg-type]
    except ValueError:
        return "(...)"
    parameters = [part.replace(annotation=inspect.Parameter.empty) for part in signature.parameters.values()]
    return str(signature.replace(parameters=parameters, return_annotation=inspect.Signature.empty))


def recipes() -> str:
    """Return every recipe: its name, its docstring, its networks and its length."""
    from lidar2pano.train.recipes import MODULES, makers

    recipes = {name: makers(module)[name] for module, names in MODULES.items() for name in names}

    def row(name: str) -> list[str]:
        recipe = recipes[name]()
        networks = ", ".join(f"`{network.model}`" for network in recipe.networks.values())
        training = recipe.training
        limit = f"{training.epochs:g} epochs" if training.epochs else f"{training.steps} steps"
        limit = f"{training.minutes:g} min" if training.minutes else limit
        return [
            f"`{name}`",
            _first(recipes[name].__doc__) or _variant(name, set(recipes)),
            networks,
            f"{limit}, batch {recipe.training.batch}",
        ]

    return table(["recipe", "purpose", "networks", "length"], map(row, recipes))


def _variant(name: str, recipes: set[str]) -> str:
    """Describe a recipe without a docstring: the small form of another, or another with a part left out."""
    if name.removesuffix("-mini") in recipes - {name}:
        return f"`{name.removesuffix('-mini')}` for two CPU cores."
    base, _, part = name.partition("-no-")
    return f"`{base}` without {part}, the paper's ablation." if part and base in recipes else ""


def paper_rows() -> str:
    """Return every row of the paper's tables: its recipes, and its command."""
    from lidar2pano.reproduce.run import ROWS

    def row(name: str) -> list[str]:
        parts = " + ".join(f"`{part}`" for part in ROWS[name].parts)
        origin = ROWS[name].source if ROWS[name].paper or ROWS[name].miou is not None else "ours, beside it"
        return [ROWS[name].name, "1, 2" if ROWS[name].segments else "2", origin, parts, f"`--rows {name}`"]

    return table(["row", "tables", "from", "recipes", "option of `reproduce`"], map(row, ROWS))


def views() -> str:
    """Return the table of rasters."""
    from lidar2pano import VIEWS

    rows = (
        [f"`{name}`", f"{view.rows} x {view.columns}", view.kind, f"{view.up:g} to {view.down:g}"]
        + [f"{view.left:g} to {view.right:g}"]
        for name, view in VIEWS.items()
    )
    return table(["view", "rows x columns", "form", "elevation: degrees (sphere), tangent (cylinder)", "azimuth"], rows)


def classes() -> str:
    """Return ids, names and colours of the classes of the panorama, of SemanticKITTI and of Cityscapes."""
    from lidar2pano import CITYSCAPES, COMMON15, SEMANTIC_KITTI

    parts = []
    for labels in (COMMON15, SEMANTIC_KITTI, CITYSCAPES):
        raw = labels.raw or range(len(labels))
        rows = (
            [index, name, value, f'<span style="background: rgb{colour}">&emsp;</span> `#{bytes(colour).hex()}`']
            for index, (name, value, colour) in enumerate(zip(labels.classes, raw, labels.colours, strict=True))
        )
        parts.append(f"### {labels.name}\n\n{table(['id', 'class', 'id in files', 'colour'], rows)}")
    return "\n\n".join(parts)


def released() -> str:
    """Return the released families, from the cards of their files."""
    from lidar2pano.models.card import read_card
    from lidar2pano.models.families import families

    def row(family: str, file: Path) -> list[str]:
        card = read_card(file)
        size = f"{file.stat().st_size / MIB:.1f} MiB"
        return [f"`{family}`", file.stem, f"`{card.network}`", size, str(card.licence), f"{card.hours:.1f} h"]

    rows = (row(name, file) for name, folder in families().items() for file in sorted(folder.glob("*.safetensors")))
    return table(["family", "part", "network", "size", "licence", "last stage trained for"], rows)


def published() -> str:
    """Return the networks with importable published weights, with addresses and licences."""
    from lidar2pano.models.published import PUBLISHED

    rows = ([f"`{name}`", f"<{item.upstream}>", item.licence] for name, item in PUBLISHED.items())
    return table(["network", "published at", "licence, as stated there"], rows)


def measured_ms(row: str) -> float:
    """Return the median of a row of docs/results/times.txt, milliseconds."""
    text = (DOCS / "results" / "times.txt").read_text(encoding="utf-8")
    match = re.search(rf"^\| {row} \| ([\d.]+) \|", text, flags=re.MULTILINE)
    if not match:
        raise KeyError(row)
    return float(match[1])


def measured_engine() -> str:
    """Return the engine and the arithmetic of docs/results/times.txt, "torch in bfloat16"."""
    head = (DOCS / "results" / "times.txt").read_text(encoding="utf-8").partition("\n")[0]
    arithmetic = "bfloat16" if "bfloat16 True" in head else "float32"
    return f"{head.partition('engine ')[2].partition(',')[0]} in {arithmetic}"


FLEET_GPU = {
    "one H200, one process": 1000 / 131,
    "one GPU, the aim": 20.0,
}  # panoramas a second: engines.md, the design
CORE_PRICE, GPU_PRICE = 0.04, 3.0  # an hour


def fleet() -> str:
    """Return panoramas a second and times for a million, of one core by the measured time and of GPUs."""
    whole_ms, png_ms = measured_ms("whole panorama"), measured_ms("stage save")
    rates = {"one core (of two)": 1000 / whole_ms / 2} | FLEET_GPU
    hours = {name: 1e6 / rate / 3600 for name, rate in rates.items()}
    rows = ([name, f"{rate:.2f}", f"{86400 * rate:,.0f}", f"{hours[name]:,.0f} hours"] for name, rate in rates.items())
    core, gpu, aim = hours.values()
    costs = f"{core * CORE_PRICE:.0f} at {CORE_PRICE} per core and hour; {gpu * GPU_PRICE:.0f} at {GPU_PRICE:g}"
    head = ["", "panoramas a second", "a day", "time for a million"]
    return f"""{table(head, rows)}

The first row is half of two idle cores' rate ([Results](../../RESULTS.md): {whole_ms:.0f} ms for the whole panorama,
by {measured_engine()}), the second is one [NVIDIA H200](engines.md#on-a-gpu) (131 ms, one scan after another, its PNG
included; `bulk` itself was not run there), the third the aim of the design.

Cost of a million panoramas, at prices that you should replace by yours: {costs} per GPU and hour,
{aim * GPU_PRICE:.0f} at the aim. A card that is fed by too few cores waits for them: coding a panorama as PNG
takes {png_ms:.0f} ms of a core, so 20 a second need {0.02 * png_ms:.1f} cores for that alone; give each card 4.
(`--format webp` and `jpeg` cost other times.)"""


def extras() -> str:
    """Return the optional dependencies, from pyproject.toml."""
    rows = (
        [f"`{name}`", "all of these" if name == "all" else ", ".join(packages)]
        for name, packages in PROJECT["optional-dependencies"].items()
    )
    return table(["extra", "packages"], rows)


# --- messages -------------------------------------------------------------------------------------------------------

GAP = "…"  # in a message: a value


def messages(source: Path = SOURCE) -> dict[str, str]:
    """Return every message of an InputError in the code: text, with GAP for values -> the module."""
    modules: dict[str, str] = {}
    for path in sorted(source.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "InputError" and node.args:
                text = re.sub(f"{GAP}+", GAP, _template(node.args[0]))
                if len(text.replace(GAP, "")) > len(": ;"):
                    modules.setdefault(text, path.relative_to(source).as_posix())
    return modules


def texts(source: Path = SOURCE) -> set[str]:
    """Return every text in the code, with GAP for values."""
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
    """Return all messages, by part of the package."""
    groups: dict[str, list[str]] = {}
    for text, module in messages().items():
        groups.setdefault(module.partition("/")[0].removesuffix(".py"), []).append(text)
    return "\n\n".join(
        f"## {group}\n\n" + "\n".join(f"- `{text}`" for text in sorted(texts)) for group, texts in groups.items()
    )


def quoted(page: str) -> list[str]:
    """Return the messages on the troubleshooting page: its third-level headings in backticks."""
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
    "fleet": fleet,
    "messages": message_index,
}

if __name__ == "__main__":
    sys.path.insert(0, str(SOURCE.parent))
    for changed_page in write_parts():
        print(changed_page.relative_to(ROOT))
