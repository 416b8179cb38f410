"""Grammar of names, docstrings and comments, as figures over a source tree.

A name should be a noun, and a docstring should begin with a verb or a noun phrase. Violations are counted: bound names
that are adverbs, prepositions, pronouns or bare participles, question words, and docstrings that begin with one.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

WORDS = """
found one each known before around of by said given read beside there here other others alike alone seen
wanted both either such same what which that this these those it its with without within below above between
against after until till since from into onto upon at to for
"""
NO_NOUNS = frozenset(WORDS.split())
QUESTION_WORDS = ("what", "where", "which", "that")
QUESTIONS = {"What", "Where", "How", "Whether", "Who", "Which", "That", "When"}


@dataclass(kw_only=True)
class Grammar:
    """Figures of a source tree.

    names     number of bound names;  no_nouns: "file:line name" of those that are none.
    words     number of words in docstrings and comments;  counts: of QUESTION_WORDS among them.
    headless  "file:line" of docstrings that begin with one of QUESTIONS.
    """

    names: int = 0
    no_nouns: list[str] = field(default_factory=list)
    words: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    headless: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, float]:
        """Return the share of names that are no nouns in percent, question words per 1,000, and headless docstrings."""
        shares = {word: round(1000 * self.counts[word] / max(self.words, 1), 2) for word in QUESTION_WORDS}
        return {
            "no nouns": round(100 * len(self.no_nouns) / max(self.names, 1), 2),
            **shares,
            "headless": len(self.headless),
        }


def measure(source: Path, omitted: Iterable[str] = ()) -> Grammar:
    """Measure all Python files below a folder, but those in folders of the omitted names."""
    grammar = Grammar()
    for path in sorted(source.rglob("*.py")):
        place = path.relative_to(source)
        if set(omitted).isdisjoint(place.parts):
            _add(grammar, place, path.read_text(encoding="utf-8"))
    return grammar


def _add(grammar: Grammar, place: Path, text: str) -> None:
    for node in ast.walk(ast.parse(text)):
        for name in _bound_names(node):
            grammar.names += 1
            if name.strip("_") in NO_NOUNS:
                grammar.no_nouns.append(f"{place}:{getattr(node, 'lineno', 1)} {name}")
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module):
            words = _add_words(grammar, ast.get_docstring(node) or "")
            if words and words[0] in QUESTIONS:
                grammar.headless.append(f"{place}:{getattr(node, 'lineno', 1)}")
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            _add_words(grammar, token.string)


def _add_words(grammar: Grammar, text: str) -> list[str]:
    words = re.findall(r"[A-Za-z']+", text)
    grammar.words += len(words)
    grammar.counts.update(word.lower() for word in words if word.lower() in QUESTION_WORDS)
    return words


def _bound_names(node: ast.AST) -> Iterator[str]:
    """Yield the names that a node binds: arguments, assigned names, declared attributes, aliases of imports."""
    if isinstance(node, ast.arg):
        yield node.arg
    elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
        yield node.id
    elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Attribute):
        yield node.target.attr
    elif isinstance(node, ast.alias) and node.asname:
        yield node.asname
