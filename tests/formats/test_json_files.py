"""Tables as JSON: read row by row, in pieces of any size, and refused where they are damaged."""

from __future__ import annotations

import json

import pytest

from lidar2pano.errors import InputError
from lidar2pano.formats import json_files
from lidar2pano.formats.json_files import LONGEST_ROW, table_rows

ROWS = [{"token": "a", "K": [[1, 2], []], "big": 2**40}, {"token": "b", "K": [], "text": "x, y: [z]"}, {"token": "c"}]


@pytest.mark.parametrize("block", [1, 7, 1 << 22])
@pytest.mark.parametrize("indent", [None, 0, 2])
def test_rows_are_those_of_the_list(tmp_path, monkeypatch, block, indent):
    monkeypatch.setattr(json_files, "BLOCK_BYTES", block)
    path = tmp_path / "a.json"
    path.write_text(json.dumps(ROWS, indent=indent) + "\n")
    assert list(table_rows(path)) == ROWS
    path.write_text(" [ ] ")
    assert list(table_rows(path)) == []


def test_what_is_not_wanted_is_not_parsed(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('[{"token": "a", nonsense}, {"token": "b"}]')
    assert list(table_rows(path, lambda fields: b'"b"' in fields)) == [{"token": "b"}]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "ends within a row"),
        ("[", "ends within a row"),
        ('[{"a": 1}', "ends within a row"),
        ('[{"a": 1}, {"a": ', "ends within a row"),
        ('[{"a": 1}]]', "ends within a row"),
        ('[{"a": 1} {"a": 1}]', "is no list of flat objects"),
        ('{"a": 1}', "is no list of flat objects"),
        ('[{"a": {"b": 1}}]', "is no JSON|is no list of flat objects"),
        ('[{"a": {"b": 1}}, {"a": 1}]', "is no JSON|is no list of flat objects"),
        ("}", "is no list of flat objects"),
        ('[{"a": NaN}]', "is no JSON"),
        ('[{"a": 1' + " " * (LONGEST_ROW + 1), f"has a row of more than {LONGEST_ROW} bytes"),
    ],
)
def test_what_is_damaged_is_refused_in_one_line(tmp_path, content, message):
    path = tmp_path / "a.json"
    path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        list(table_rows(path))
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"a.json: cannot be read \(No such file"):
        list(table_rows(tmp_path / "a.json"))
