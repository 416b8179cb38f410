"""Names are nouns, docstrings begin with verbs: figures of the package stay below ceilings, which only come down."""

from __future__ import annotations

from pathlib import Path

import pytest

import house_rules
from grammar import measure

# percent of bound names that are no nouns; question words per 1,000 words; docstrings that begin with one
CEILINGS = {"no nouns": 0.3, "what": 1.3, "where": 2.3, "which": 1.7, "that": 4.7, "headless": 10}


def test_the_package_stays_below_the_ceilings():
    grammar = measure(house_rules.SOURCE, omitted=("simulate",))
    figures = grammar.figures()
    above = {name: value for name, value in figures.items() if value > CEILINGS[name]}
    assert above == {}, f"{figures}; {grammar.no_nouns[:20]}; {grammar.headless[:20]}"
    assert grammar.names > 1000 and grammar.words > 10_000


# --- small trees ------------------------------------------------------------------------------------------------------


def figures_of(folder: Path, text: str) -> dict[str, float]:
    (folder / "part.py").write_text(text)
    return measure(folder).figures()


@pytest.mark.parametrize(
    "text",
    [
        "def f(found): pass",
        "def f(*, of=1): pass",
        "each = 1",
        "_before = 1",
        "for known in (): pass",
        "self.around: int = 1",
        "with open() as read: pass",
        "import math as by",
        "[0 for one in ()]",
        "if (given := 1): pass",
    ],
)
def test_a_name_that_is_no_noun_counts(tmp_path, text):
    assert figures_of(tmp_path, text)["no nouns"] == 100


@pytest.mark.parametrize("text", ["found_count = 1", "def read(scan): pass", "x.of", "f(by=1)", "# each", "import by"])
def test_other_names_do_not_count(tmp_path, text):
    assert figures_of(tmp_path, text)["no nouns"] == 0


def test_question_words_are_counted_in_docstrings_and_comments(tmp_path):
    figures = figures_of(tmp_path, '"""Say what that is."""\nx = "what"  # where a thing stands\n')
    assert (figures["what"], figures["that"], figures["where"], figures["which"]) == (125, 125, 125, 0)
    assert figures["headless"] == 0


def test_a_docstring_that_begins_with_a_question_word_counts(tmp_path):
    assert figures_of(tmp_path, 'def f():\n    """What is said."""\nclass A:\n    """Whether so."""\n')["headless"] == 2


def test_folders_may_be_left_out(tmp_path):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "part.py").write_text("found = 1")
    assert measure(tmp_path).names == 1 and measure(tmp_path, omitted=("other",)).names == 0
