"""The house rules as functions over a source tree: each returns its violations as lines of text, [] when there is none.

`test_structure.py` applies them to the package, and to small bad trees to see that they bite.
Run this file to write `api_inventory.txt` again after a wanted change of the public names.
"""

from __future__ import annotations

import ast
import functools
import inspect
import sys
from collections.abc import Iterable, Iterator
from dataclasses import is_dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "lidar2pano"
SOURCE = ROOT / "src" / PACKAGE
INVENTORY = ROOT / "tests" / "package" / "api_inventory.txt"

# What may import what: strictly downwards, and sideways only inside one package. Modules named cli* are the door.
FLOORS: tuple[frozenset[str], ...] = (
    frozenset({"scan", "views", "labels", "calibration", "name_order", "child_process", "progress", "markdown"}),
    frozenset({"formats", "geometry", "hardware", "demo"}),
    frozenset({"scene"}),
    frozenset(
        {
            "models",
            "losses",
            "metrics",
            "data",
            "panorama",
            "memory",
            "simulate",
            "recordings",
            "engines",
        }
    ),
    frozenset({"pipeline", "drives", "viewer", "annotations"}),
    frozenset({"translation"}),
    frozenset({"prepare", "train", "evaluate", "bench", "bulk", "serve"}),
    frozenset({"reproduce"}),
    frozenset({"cli", "__main__"}),
)
DOOR = len(FLOORS) - 1
ANYWHERE = {"errors", "bounded_files"}  # below every floor: the one exception class, and files read within bounds

MOST_FUNCTION_LINES, MOST_PARAMETERS = 60, 8
# Where files may be called like others: by folder, and by file name.
SAME_NAME = {
    "cli": "a command's file is called like the command",
    "panorama.py": "the record, and the task that trains its translator",
    "surfaces.py": "scene/ has surfaces of a scan, simulate/ makes the world's",
}
EMPTY_NAMES = {"util", "utils", "common", "core", "base", "helper", "helpers", "misc"}


def parsed(source: Path) -> Iterator[tuple[Path, ast.Module]]:
    """Every Python file below `source`, its path relative to `source`, and its tree."""
    for path in sorted(source.rglob("*.py")):
        yield path.relative_to(source), tree_of(path.read_text(encoding="utf-8"))


@functools.cache
def tree_of(text: str) -> ast.Module:
    """Parse a text once, however many rules read it; nobody may change the tree."""
    return ast.parse(text)


@functools.cache
def nodes_of(tree: ast.AST) -> tuple[ast.AST, ...]:
    """Walk a tree once."""
    return tuple(ast.walk(tree))


def dotted(node: ast.expr) -> str:
    """Return the written form of a name with attributes, `a.b().c` as ".c"; "" of everything else."""
    if isinstance(node, ast.Name):
        return node.id
    return f"{dotted(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else ""


def module_of(path: Path) -> str:
    """`models/titan.py` -> "models", `losses.py` -> "losses", the package's own `__init__.py` -> ""."""
    first = path.parts[0].removesuffix(".py")
    return "" if first == "__init__" else first


def at_door(module: str) -> bool:
    """Whether a module of this name belongs to the command line."""
    return module.startswith("cli") or module in FLOORS[DOOR]


def floor_of(module: str) -> int | None:
    """The floor of a module or subpackage; None when it is not entered."""
    if at_door(module):
        return DOOR
    return next((floor for floor, modules in enumerate(FLOORS) if module in modules), None)


def imports(tree: ast.Module, path: Path) -> Iterator[str]:
    """Dotted names of everything that a file imports, at any depth; `from a import b` gives "a.b"."""
    yield from _imports(nodes_of(tree), path)


def _imports(nodes: Iterable[ast.AST], path: Path) -> Iterator[str]:
    folder = [PACKAGE, *path.parts[:-1]]
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = folder[: len(folder) - node.level + 1] if node.level else []
            module = ".".join([*start, *([node.module] if node.module else [])])
            yield from (f"{module}.{alias.name}" for alias in node.names)


def climbs(source: Path) -> list[str]:
    """Imports that do not go strictly downwards, and modules that stand on no floor."""
    found: list[str] = []
    for path, tree in parsed(source):
        ours = module_of(path)
        if not ours:
            continue  # the package itself only hands names on, on first use
        if ours not in ANYWHERE and floor_of(ours) is None:
            found.append(f"{path}: {ours!r} is on no floor; enter it in FLOORS of tests/support/house_rules.py")
            continue
        for name in sorted(set(imports(tree, path))):
            theirs = _inner_module(name, source)
            if theirs is not None and (fault := _climb(ours, theirs)):
                found.append(f"{path} ({ours}) imports {name}: {fault}")
    return found


def _inner_module(name: str, source: Path) -> str | None:
    """The module of this package behind a dotted import; "" for the package's own names, None for other packages."""
    package, _, rest = name.partition(".")
    if package != PACKAGE:
        return None
    first = rest.partition(".")[0]
    known = (source / f"{first}.py").exists() or (source / first / "__init__.py").exists()
    return first if known or "." in rest else "" if first != "__version__" else None


def _climb(ours: str, theirs: str) -> str | None:
    """Say what is wrong with `mine` importing `theirs`, or None."""
    if ours == theirs or theirs in ANYWHERE:
        return None
    here, there = -1 if ours in ANYWHERE else floor_of(ours), floor_of(theirs)
    if not theirs:
        return None if here == DOOR else "inside the package, import from the module itself"
    if there is None or here is None:
        return f"{theirs!r} is on no floor"
    if here == DOOR == there or there < here:
        return None
    return f"floor {here} may not know floor {there}"


def circles(source: Path) -> list[str]:
    """Return files that import each other in a circle, at any depth of their functions but not for types alone."""
    trees = dict(parsed(source))
    file_of = {".".join([PACKAGE, *path.with_suffix("").parts]).removesuffix(".__init__"): path for path in trees}
    imported = {path: _imported_files(path, tree, file_of) for path, tree in trees.items()}
    reached: dict[Path, set[Path]] = {}
    for path in trees:
        reached[path], waiting = set(), list(imported[path])
        while waiting:
            if (file := waiting.pop()) not in reached[path]:
                reached[path].add(file)
                waiting += imported[file]
    rings = {tuple(sorted(f for f in reached[path] if path in reached[f])) for path in trees if path in reached[path]}
    return [f"{' and '.join(map(str, ring))} import each other in a circle" for ring in sorted(rings)]


def _imported_files(path: Path, tree: ast.Module, file_of: dict[str, Path]) -> set[Path]:
    """Return the files of the package that a file imports when it runs."""
    for_types = [node for node in nodes_of(tree) if isinstance(node, ast.If) and dotted(node.test) == "TYPE_CHECKING"]
    skipped = {id(node) for block in for_types for statement in block.body for node in ast.walk(statement)}
    running = _imports((node for node in nodes_of(tree) if id(node) not in skipped), path)
    names = {file_of.get(name) or file_of.get(name.rpartition(".")[0]) for name in running}
    return {file for file in names if file and file != path}


def foreign(source: Path) -> list[str]:
    """Imports on floor 0 from outside numpy, the standard library and floor 0 itself."""
    allowed = {"numpy", PACKAGE, *sys.stdlib_module_names}
    return [
        f"{path} imports {name}: floor 0 knows numpy and the standard library"
        for path, tree in parsed(source)
        if module_of(path) in FLOORS[0] | ANYWHERE
        for name in sorted(set(imports(tree, path)))
        if name.partition(".")[0] not in allowed
    ]


def too_big(source: Path) -> list[str]:
    """Functions and parameter lists over the limits."""
    found: list[str] = []
    for path, tree in parsed(source):
        for node in nodes_of(tree):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            if (lines := (node.end_lineno or node.lineno) - node.lineno + 1) > MOST_FUNCTION_LINES:
                found.append(f"{path}:{node.lineno} {node.name} has {lines} lines (limit {MOST_FUNCTION_LINES})")
            options = any("command" in ast.unparse(decorator) for decorator in node.decorator_list)
            if (count := _parameters(node.args)) > MOST_PARAMETERS and not (options and at_door(module_of(path))):
                found.append(f"{path}:{node.lineno} {node.name} takes {count} parameters (limit {MOST_PARAMETERS})")
    return found


def _parameters(args: ast.arguments) -> int:
    """Parameters that a caller sees: without self and cls."""
    named = [arg.arg for arg in (*args.posonlyargs, *args.args, *args.kwonlyargs)]
    return len([name for name in named if name not in {"self", "cls"}]) + bool(args.vararg) + bool(args.kwarg)


def unread(configs: Path, source: Path) -> list[str]:
    """Fields of the dataclasses in the file `configs` that no code below `source` reads from a value of their class.

    A value is known by what it is called: an annotation `name: Class` makes `name` one in its top-level function or
    class, and everywhere if it is a field in `configs`; `Recipe[Class]` makes `options` one.
    """
    classes = {
        node.name: [item for item in node.body if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)]
        for node in tree_of(configs.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef) and any("dataclass" in ast.unparse(d) for d in node.decorator_list)
    }
    parts = {
        name: {part.target.id for parts in classes.values() for part in parts if _mentions(part.annotation, name)}
        for name in classes
    }
    read = {
        (name, attribute)
        for _, tree in parsed(source)
        for scope in tree.body
        for name, called in _names_of(scope, parts).items()
        for base, attribute in _reads(scope)
        if base in called
    }
    return [
        f"{name}.{field.target.id} is read nowhere"
        for name, fields in classes.items()
        for field in fields
        if "ClassVar" not in ast.unparse(field.annotation) and (name, field.target.id) not in read
    ]


def _mentions(annotation: ast.expr, name: str) -> bool:
    return any(isinstance(node, ast.Name) and node.id == name for node in ast.walk(annotation))


def _names_of(scope: ast.stmt, parts: dict[str, set[str]]) -> dict[str, set[str]]:
    """Class -> what its values are called in a function or class: `parts`, and what is annotated there."""
    called_by_class = {name: set(called) for name, called in parts.items()}
    for target, mentioned in _annotations(scope):
        for name in mentioned & called_by_class.keys():
            called_by_class[name].add("options" if "Recipe" in mentioned and name != "Recipe" else target)
    return called_by_class


@functools.cache
def _annotations(scope: ast.stmt) -> tuple[tuple[str, frozenset[str]], ...]:
    """(what is annotated, names in its annotation) of every annotation in a function or class."""
    return tuple(
        (
            node.arg if isinstance(node, ast.arg) else dotted(node.target).rpartition(".")[2],
            frozenset(name.id for name in ast.walk(node.annotation) if isinstance(name, ast.Name)),
        )
        for node in nodes_of(scope)
        if isinstance(node, ast.arg | ast.AnnAssign) and node.annotation is not None
    )


@functools.cache
def _reads(scope: ast.stmt) -> frozenset[tuple[str, str]]:
    """(what a value is called, attribute) of every attribute that is read; `a.b[c].d` reads (b, d)."""
    pairs = set()
    for node in nodes_of(scope):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
            base = node.value.value if isinstance(node.value, ast.Subscript) else node.value
            if isinstance(base, ast.Name | ast.Attribute):
                pairs.add(((base.id if isinstance(base, ast.Name) else base.attr), node.attr))
    return frozenset(pairs)


def noisy(source: Path) -> list[str]:
    """Calls outside the command line that print, leave the process or set up logging."""
    loud = {"print", "exit", "quit", "sys.exit", "os._exit", "sys.stdout.write", "sys.stderr.write"}
    found: list[str] = []
    for path, tree in parsed(source):
        if at_door(module_of(path)):
            continue
        for node in nodes_of(tree):
            called = dotted(node.func) if isinstance(node, ast.Call) else ""
            if called in loud or called.endswith((".print", ".basicConfig", ".addHandler")):
                found.append(f"{path}:{node.lineno} calls {called}: only the command line speaks")
    return found


def empty_names(source: Path) -> list[str]:
    """Files and folders whose names say nothing about what is in them."""
    return [
        f"{path}: the name says nothing"
        for path, _ in parsed(source)
        if EMPTY_NAMES & {word for part in path.with_suffix("").parts for word in part.split("_")}
    ]


def repeated_names(source: Path) -> list[str]:
    """Files that are called alike, other than `__init__.py` and the like and what SAME_NAME gives a reason for."""
    places: dict[str, list[str]] = {}
    for path, _ in parsed(source):
        if not path.stem.startswith("__") and not SAME_NAME.keys() & {path.parent.name, path.name}:
            places.setdefault(path.name, []).append(path.as_posix())
    return [f"{' and '.join(paths)} are called alike" for paths in places.values() if len(paths) > 1]


def idle_exceptions(source: Path) -> list[str]:
    """Files in SAME_NAME whose name no two files have any more."""
    names = [path.name for path, _ in parsed(source)]
    return [name for name in SAME_NAME if name.endswith(".py") and names.count(name) < 2]


def second_builders(source: Path, networks: set[str]) -> list[str]:
    """Places outside `models/` that construct a network class themselves instead of calling `models.build`."""
    return [
        f"{path}:{node.lineno} constructs {called}: call models.build"
        for path, tree in parsed(source)
        if module_of(path) != "models"
        for node in nodes_of(tree)
        if isinstance(node, ast.Call) and (called := dotted(node.func).rpartition(".")[2]) in networks
    ]


def inventory() -> str:
    """The public names of the package with their signatures, one a line; members of classes indented."""
    package = __import__(PACKAGE)
    lines: list[str] = []
    for name in sorted(package.__all__):
        value = getattr(package, name)
        if inspect.isclass(value):
            dataclass = "dataclass " if is_dataclass(value) else "class "
            lines.append(f"{dataclass}{name}{_signature(value)}")
            lines.extend(f"    {line}" for line in _members(value))
        elif inspect.isfunction(value):
            lines.append(f"def {name}{_signature(value)}")
        else:
            lines.append(f"{name}: {type(value).__name__}")
    return "\n".join(lines) + "\n"


def _members(owner: type) -> Iterator[str]:
    """Public methods and properties that a class itself defines."""
    fields = getattr(owner, "__dataclass_fields__", {})
    for name, member in sorted(vars(owner).items()):
        if (name.startswith("_") and name != "__call__") or name in fields:
            continue
        if isinstance(member, property):
            yield f"{name}: property"
        elif isinstance(member, classmethod | staticmethod):
            yield f"{name}{_signature(member.__func__)}"
        elif inspect.isfunction(member):
            yield f"{name}{_signature(member)}"


class Written(str):
    """An annotation as it is written in the source, which `inspect` would show in quotes."""

    __slots__ = ()
    __repr__ = str.__str__


def _signature(of: object) -> str:
    """A signature with annotations as they are written in the source; empty where Python knows none."""
    try:
        found = inspect.signature(of)  # type: ignore[arg-type]
    except ValueError:
        return ""
    named = [parameter.replace(annotation=_written(parameter.annotation)) for parameter in found.parameters.values()]
    return str(found.replace(parameters=named, return_annotation=_written(found.return_annotation)))


def _written(annotation: object) -> object:
    return Written(annotation) if isinstance(annotation, str) else annotation


if __name__ == "__main__":
    INVENTORY.write_text(inventory(), encoding="utf-8")
