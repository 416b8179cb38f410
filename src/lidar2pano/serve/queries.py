"""Requests for panoramas: query parameters, and the scan file in the form of an upload."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from email.message import Message
from email.parser import BytesHeaderParser

from lidar2pano.drives.reading import ReadingOptions
from lidar2pano.errors import InputError, closest
from lidar2pano.formats.interpretation import Overrides
from lidar2pano.serve.uploads import parse_parts

ANSWERS = ("png", "zip", "json")
PARAMETERS = ("as", "save", "name", "forward", "remission", "sensor-height", "strict")
TRUTHS = dict.fromkeys(("", "1", "true", "yes"), True) | dict.fromkeys(("0", "false", "no"), False)
FORM = "multipart/form-data"


class UnknownParameter(InputError):
    """A query parameter without a meaning."""


@dataclass(frozen=True, kw_only=True)
class Query:
    """A request's parameters.

    answer  form of the answer, one of ANSWERS;  save: outputs, of FILES;  name: of the file, for its ending.
    reading  overrides, and whether an implausible scan is an error.
    """

    answer: str
    save: tuple[str, ...]
    name: str
    reading: ReadingOptions


def parse_query(parameters: Mapping[str, str]) -> Query:
    """Return a request's parameters; UnknownParameter for an unknown name, InputError for a value of no use."""
    if unknown := [name for name in parameters if name not in PARAMETERS]:
        raise UnknownParameter(
            f"{unknown[0]}: unknown parameter{closest(unknown[0], PARAMETERS)}; known are {', '.join(PARAMETERS)}"
        )
    answer, save = parameters.get("as", "png"), parse_parts(parameters.get("save", "rgb"))
    if answer not in ANSWERS:
        raise InputError(f"as: there is {', '.join(ANSWERS)}")
    if answer == "png" and save != ("rgb",):
        raise InputError("save: a PNG holds rgb alone; ask for as=zip or as=json")
    if (strict := parameters.get("strict", "0").lower()) not in TRUTHS:
        raise InputError("strict: is true or false")
    reading = ReadingOptions(overrides=_overrides(parameters), strict=TRUTHS[strict])
    return Query(answer=answer, save=save, name=parameters.get("name", ""), reading=reading)


def _overrides(parameters: Mapping[str, str]) -> Overrides:
    height = parameters.get("sensor-height", "")
    try:
        height_m = float(height) if height else None
    except ValueError:
        raise InputError(f"sensor-height: {height[:20]!r} is no height above the ground in metres") from None
    try:
        forward, remission = parameters.get("forward", ""), parameters.get("remission", "")
        return Overrides(sensor_height_m=height_m, forward=forward, remission=remission)
    except InputError as error:
        raise InputError(str(error).removeprefix("--")) from None


def file_of_form(body: bytes, content_type: str) -> tuple[bytes, str]:
    """Return the content and name of the file in a form (RFC 7578); any other body as it is, without a name.

    Raises InputError for a form without a file, or with several or other fields.
    """
    header = Message()
    header["content-type"] = content_type
    boundary = header.get_param("boundary")
    if header.get_content_type() != FORM or not isinstance(boundary, str):
        return body, ""
    parts = (b"\r\n" + body).split(b"\r\n--" + boundary.encode("latin-1", "replace"))[1:-1]
    if len(parts) != 1:
        raise InputError(f"form: holds {len(parts)} fields; send the scan file alone, and options in the URL")
    head, separator, content = parts[0].lstrip(b"\r\n").partition(b"\r\n\r\n")
    if not separator:
        raise InputError("form: its field has no content; send the bytes of a scan file")
    return content, BytesHeaderParser().parsebytes(head).get_filename() or ""
