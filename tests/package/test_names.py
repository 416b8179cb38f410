"""The project speaks the field's language: no word of its former private dialect in names, comments or messages."""

from __future__ import annotations

from pathlib import Path

import pytest

import banned_words
from banned_words import IN_IDENTIFIERS, IN_PROSE, in_identifiers, in_prose

ROOT = Path(__file__).resolve().parents[2]
CODE = ("src", "runs", "tests")
PAGES = ("README.md", "CONTRIBUTING.md", "CONVENTIONS.md", "docs", "examples")


def lines(hits: list[banned_words.Hit]) -> str:
    return "\n".join(map(str, hits))


@pytest.mark.parametrize("folder", CODE)
def test_no_identifier_has_a_banned_word(folder: str) -> None:
    assert lines(in_identifiers(ROOT, [folder])) == ""


@pytest.mark.parametrize("folder", [*CODE, *PAGES])
def test_no_sentence_has_a_banned_word(folder: str) -> None:
    assert lines(in_prose(ROOT, [folder])) == ""


# --- small bad trees ------------------------------------------------------------------------------------------------


def written(root: Path, text: str, name: str = "src/part.py") -> Path:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return root


@pytest.mark.parametrize(
    "text",
    [
        "def told(): pass",
        "async def is_told(): pass",
        "class BeingTold: pass",
        "def f(told): pass",
        "def f(*, x_told=1): pass",
        "f = lambda told: 0",
        "told2 = 1",
        "TOLD: int = 1",
        "for told, x in (): pass",
        "self.told = 1",
        "with open() as told: pass",
        "import math as told",
        "[0 for told in ()]",
        "try: pass\nexcept OSError as told: pass",
        "match x:\n    case [told, *_]: pass",
        "if (told := 1): pass",
    ],
)
def test_a_banned_word_in_any_identifier_is_found(tmp_path: Path, text: str) -> None:
    (hit,) = in_identifiers(written(tmp_path, text), ["src"])
    assert hit.word == "told" and str(hit).startswith(f"src/part.py:{hit.line}: ")
    assert "rather: given" in str(hit)


@pytest.mark.parametrize("word", IN_IDENTIFIERS)
def test_every_banned_word_is_found(tmp_path: Path, word: str) -> None:
    (hit,) = in_identifiers(written(tmp_path, f"\n{word}_of = 1"), ["src"])
    assert (hit.word, hit.line) == (word, 2)


def test_names_of_files_and_folders_count(tmp_path: Path) -> None:
    written(tmp_path, "", "src/films/good.py")
    written(tmp_path, "", "src/plain/moments.py")
    assert [hit.word for hit in in_identifiers(tmp_path, ["src"])] == ["films", "moments"]


def test_whole_names_are_compared_whole(tmp_path: Path) -> None:
    written(tmp_path, "class Draw: pass\ndef draw(): pass\nclass DrawOrder: pass")
    assert [hit.line for hit in in_identifiers(tmp_path, ["src"])] == [1]


@pytest.mark.parametrize(
    "text",
    [
        "view.kind",
        "f(kind=1)",
        "retold = unseen = insight = momentum = kindred = 1",
        "ground_truths = GroundTruth = GROUND_TRUTH = 1",
        "# told",
    ],
)
def test_what_is_no_banned_identifier(tmp_path: Path, text: str) -> None:
    assert in_identifiers(written(tmp_path, text), ["src"]) == []


def test_exceptions_hold_in_their_files_only(tmp_path: Path) -> None:
    written(tmp_path, "sharp = 1", "src/lidar2pano/models/scene_painter.py")
    assert in_identifiers(tmp_path, ["src"]) == []
    written(tmp_path, "sharp = 1", "src/lidar2pano/models/other.py")
    assert [hit.path.name for hit in in_identifiers(tmp_path, ["src"])] == ["other.py"]


@pytest.mark.parametrize("word", IN_PROSE)
def test_every_banned_word_of_prose_is_found_where_prose_is(tmp_path: Path, word: str) -> None:
    text = f'"""What {word}\nis."""\nx = 1  # so {word}.\nraise ValueError(f"{{x}} is {word.title()}; {{x}}")\n'
    hits = in_prose(written(tmp_path, text), ["src"])
    assert [hit.line for hit in hits] == [1, 3, 4] and {hit.word for hit in hits} == {word}
    page = written(tmp_path, f"# Page\n\nIt is {word}.\n", "docs/page.md")
    assert [(hit.line, hit.word) for hit in in_prose(page, ["docs"])] == [(3, word)]
    assert len(in_prose(page, ["docs/page.md"])) == 1


def test_plain_english_is_no_hit(tmp_path: Path) -> None:
    text = '"""The ground truth, seen from the camera; ground-truth labels of the filmed insight; `told` is gone."""\n'
    assert in_prose(written(tmp_path, text + "told = 1\n"), ["src"]) == []
