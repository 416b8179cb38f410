"""--config: options of a command in a YAML or JSON file; those of the command line take precedence."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.main import get_command

from lidar2pano.cli.help_layout import LONG, commands_of, options_of
from lidar2pano.errors import InputError, closest

Scalar = str | int | float | bool


def add_config(command: Any) -> Any:  # noqa: ANN401 typer's classes are click's or its own
    """Let each command with many options take --config, in place; return the program."""
    for inner in commands_of(command):
        if len(options_of(inner)) >= LONG and not hasattr(inner, "commands"):
            inner.params.append(_option())
    return command


def _option() -> Any:  # noqa: ANN401
    """Return the option --config, made by typer as any other."""
    host = typer.Typer(add_completion=False)

    @host.command()
    def only(
        config: Annotated[  # noqa: ARG001 its callback takes it
            Path | None,
            typer.Option(
                metavar="FILE",
                help="Options in a YAML or JSON file, e.g. every: 2; those of the command line come first.",
                is_eager=True,
                expose_value=False,
                callback=set_defaults,
            ),
        ] = None,
    ) -> None: ...

    return get_command(host).params[0]


def set_defaults(context: typer.Context, config: Path | None) -> None:
    """Make the values of a file defaults of a command; InputError for unknown names and unfit values."""
    if config is None:
        return
    parameters = {_key(item): item for item in context.command.params if item.name != "config"}
    defaults: dict[str, Any] = {}
    for key, value in _read(config).items():
        name = str(key).replace("_", "-").removeprefix("--")
        if name not in parameters:
            raise InputError(f"{config}: {context.command.name} has no {key!r}{closest(name, parameters)}")
        parameter = parameters[name]
        converted = _converted(value, parameter, f"{config}: {key}")
        if name == "set":
            parameter.callback = _preceded(converted)
        else:
            defaults[parameter.name] = converted
    context.default_map = defaults


def _preceded(assignments: list[str]) -> Callable[[Any, Any, Any], list[str]]:
    """Return a callback of --set: the file's assignments, then those of the command line, which thus win."""
    return lambda _context, _parameter, value: [*assignments, *(value or [])]


def _read(path: Path) -> Mapping[Any, Any]:
    from lidar2pano.formats.yaml_files import read_document

    document = read_document(path, "name a YAML or JSON file with lines such as every: 2")
    if not isinstance(document, dict):
        raise InputError(f"{path}: holds no options; write lines such as every: 2")
    return document


def _key(parameter: Any) -> str:  # noqa: ANN401
    """Return an option's name without dashes, an argument's own."""
    return parameter.opts[0].removeprefix("--") if parameter.param_type_name == "option" else parameter.name


def _converted(value: Any, parameter: Any, title: str) -> Any:  # noqa: ANN401
    """Return a file's value as the command line would give it; InputError unless it can."""
    if getattr(parameter, "is_flag", False):
        if not isinstance(value, bool):
            raise InputError(f"{title}: is on or off; write true or false")
        return value
    if getattr(parameter, "multiple", False) or parameter.nargs != 1:
        return list(_assignments(value, title) if isinstance(value, dict) else _texts(value, title))
    return ",".join(_texts(value, title))


def _texts(value: Any, title: str) -> Iterator[str]:  # noqa: ANN401
    """Yield the words of a value or a list of them."""
    for item in value if isinstance(value, list) else [value]:
        if not isinstance(item, Scalar) or item == "":
            raise InputError(f"{title}: holds {'nothing' if item in (None, '') else 'no plain value'}; write one value")
        yield str(item).lower() if isinstance(item, bool) else str(item)


def _assignments(values: Mapping[Any, Any], title: str, path: str = "") -> Iterator[str]:
    """Yield A.B=C of nested names."""
    for key, value in values.items():
        name = f"{path}.{key}" if path else str(key)
        if isinstance(value, dict):
            yield from _assignments(value, title, name)
        else:
            yield f"{name}={','.join(_texts(value, f'{title}.{name}'))}"
