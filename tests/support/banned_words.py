"""Words of the private dialect this project once had: which they are, what stands instead, and where they still occur.

A word is banned in identifiers when it is a part of one: `told_by` and `ToldBy` have the word "told". Prose (comments,
docstrings, messages, pages) has a shorter list: only words that plain English does without.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

# word -> what to write instead
IN_IDENTIFIERS = {
    "told": "given, uses_ground_truth",
    "seen": "mask, valid, features, prediction, inputs",
    "moment": "frame, instant",
    "moments": "frames, instants",
    "sight": "image and labels",
    "sights": "images and labels",
    "truth": "ground_truth",
    "truths": "ground_truth, frames",
    "tally": "metrics",
    "tallies": "metrics",
    "contender": "system",
    "contenders": "systems",
    "carried": "resampled",
    "question": "system_input",
    "questions": "system_inputs",
    "lottery": "spatial_hash",
    "wish": "options",
    "wishes": "options",
    "fate": "exit_code",
    "fates": "exit_codes",
    "film": "video",
    "films": "videos",
    "grain": "noise",
    "sharp": "sharpening_exponent",
    "filled": "inpainted",
    "spoken": "summary",
    "judged": "discriminator_output, exit_status",
    "judge": "discriminator",
    "shown": "preview, previous_frame",
    "steadied": "smoothed",
    "rarity": "class_weight_exponent",
    "broad": "pooled",
    "trust": "teacher_probability",
    "picture": "image",
    "pictures": "images",
    "nobody": "unknown, unlabelled",
    "whoever": "",
    "whose": "owner, source",
    "who": "name",
    "whom": "name",
    "mine": "own",
    "asked": "arguments, requested",
    "heard": "received",
    "anew": "again",
    "unsure": "ignore",
    "lucky": "",
    "stranger": "unknown",
    "strangers": "unknown",
    "kind": "projection, layout, device_type, object_type",
    "kinds": "layouts, device_types, object_types",
}
# Names of classes and constants that were renamed; as words of English their parts stay.
WHOLE_IDENTIFIERS = {
    "Looks": "an augmentation's configuration",
    "Changes": "DiffAugment parameters",
    "Colours": "Normalisation",
    "Draw": "SampleIndex",
    "Places": "BatchSampler",
    "Average": "EMA",
    "Measures": "MetricConfig",
    "Surround": "GlobalContext",
    "Clips": "ClipDataset",
    "Photo": "Image",
}
# word -> files (relative, or folders ending in "/") in which it may stay, each with its reason
ALLOWED = {
    "sharp": ("src/lidar2pano/models/scene_painter.py",),  # cards of scene painters may name it
    "picture": ("src/lidar2pano/models/salsanext.py",),  # a setting of weights that paint colours ("w/o SegMap")
    "truth": (
        "src/lidar2pano/evaluate/systems.py",
        "tests/evaluate/test_systems.py",
    ),  # former name of the chain's part "oracle"; still accepted
    "kind": ("src/lidar2pano/views.py",),  # View.kind, which the cards of released weights have
}
LISTS = {Path("tests/support/banned_words.py"), Path("tests/package/test_names.py")}  # name the words on purpose

_WORD = r"(?<![\w`./-])(?:{})(?![\w`/-])"
# word -> its pattern; words that are fine English (seen, picture, moment, grain, carried, shown) are not here
IN_PROSE = {
    word: re.compile(_WORD.format(pattern), re.IGNORECASE)
    for word, pattern in {
        "told": "told",
        "anew": "anew",
        "nobody": "nobody",
        "whoever": "whoever",
        "film": "(?-i:(?!FiLM))films?",  # FiLM: feature-wise linear modulation
        "sight": "sights?",
        "tally": "tally|tallies",
        "contender": "contenders?",
        "lottery": "lottery",
        "wish": "wish|wishes",
        "fate": "fates?",
        "spoken": "spoken",
        "judged": "judged",
        "stranger": "strangers?",
        "truth": r"(?<!ground )(?<!ground-)truths?",  # "ground truth" is the field's term
    }.items()
}
_ANY_PROSE = re.compile("|".join(pattern.pattern for pattern in IN_PROSE.values()), re.IGNORECASE)


class Hit(NamedTuple):
    """A banned word and where it is; str() gives FILE:LINE and what to do."""

    path: Path
    line: int
    word: str
    found: str

    def __str__(self) -> str:
        instead = IN_IDENTIFIERS.get(self.word) or WHOLE_IDENTIFIERS.get(self.word, "")
        return f"{self.path}:{self.line}: {self.found!r} has {self.word!r}" + (
            f"; rather: {instead}" if instead else ""
        )


def words(identifier: str) -> list[str]:
    """`GL_toldBy2` -> ["gl", "told", "by"]; "ground truth", the field's term, is one word: ["groundtruth"]."""
    parts = [part.lower() for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", identifier)]
    return re.sub(r"\bground (?=truths?\b)", "ground", " ".join(parts)).split()


def identifiers(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """(line, name) of everything that a module names: definitions, arguments, variables, attributes, aliases."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield node.lineno, name
            case ast.arg(arg=name) | ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield node.lineno, name
            case ast.ExceptHandler(name=str(name)) | ast.MatchAs(name=str(name)) | ast.MatchStar(name=str(name)):
                yield node.lineno, name
            case ast.Import(names=aliases) | ast.ImportFrom(names=aliases):
                yield from ((node.lineno, alias.asname) for alias in aliases if alias.asname)


def in_identifiers(root: Path, folders: Iterable[str]) -> list[Hit]:
    """Hits in the names of and in the Python files below `folders` of `root`, one per name and line."""
    hits = []
    for path in _files(root, folders, {".py"}):
        relative = path.relative_to(root)
        named = {(0, part.removesuffix(".py")) for part in relative.parts[1:]}
        named |= set(identifiers(ast.parse(path.read_text(encoding="utf-8"))))
        for line, name in sorted(named):
            banned = [word for word in words(name) if word in IN_IDENTIFIERS]
            banned += [name] if name in WHOLE_IDENTIFIERS else []
            hits += [Hit(relative, line, word, name) for word in dict.fromkeys(banned) if not _allowed(word, relative)]
    return hits


def in_prose(root: Path, folders: Iterable[str]) -> list[Hit]:
    """Hits in comments and strings of Python files, and in Markdown pages, below `folders` of `root`."""
    hits = []
    for path in _files(root, folders, {".py", ".md"}):
        relative = path.relative_to(root)
        if relative in LISTS or not _ANY_PROSE.search(path.read_text(encoding="utf-8")):
            continue
        for line, text in _prose(path):
            for word, pattern in IN_PROSE.items():
                if pattern.search(text) and not _allowed(word, relative):
                    hits.append(Hit(relative, line, word, text.strip()[:80]))
    return hits


def _prose(path: Path) -> Iterator[tuple[int, str]]:
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        yield from enumerate(text.splitlines(), 1)
        return
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in {tokenize.COMMENT, tokenize.STRING} or tokenize.tok_name[token.type] == "FSTRING_MIDDLE":
            yield from enumerate(token.string.splitlines(), token.start[0])


def _files(root: Path, folders: Iterable[str], suffixes: set[str]) -> list[Path]:
    found = [path for folder in folders for path in (root / folder).rglob("*")] + [root / one for one in folders]
    return sorted(path for path in found if path.suffix in suffixes and path.is_file())


def _allowed(word: str, path: Path) -> bool:
    return any(path.as_posix().startswith(place) for place in ALLOWED.get(word, ()))
