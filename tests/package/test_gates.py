"""Every file from outside is opened by one gate; a library that chooses a decoder by content needs a reason."""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path

import pytest

import lidar2pano
from house_rules import ROOT, nodes_of, parsed

SOURCE = Path(lidar2pano.__file__).parent
# Calls that open a file by its name to read it. file -> the calls that it may make, and the reason.
OPENS: dict[str, tuple[set[str], str]] = {
    "cli/app.py": ({"open"}, "/dev/null, to write to"),
    "cli/batch.py": ({"open"}, "webbrowser.open"),
    "formats/file_contents.py": ({"open"}, "a temporary copy of our own, to write"),
    "cli/console.py": ({"open"}, "a temporary file of our own, to write"),
    "train/latent_frames.py": ({"open"}, "Image.open of bytes of our own, as JPEG alone"),
    "engines/compiled.py": ({"open", "read_bytes"}, "an engine's own `open`; our sources"),
    "evaluate/pictures.py": ({"read_text"}, "a page of the package"),
    "engines/export.py": ({"read_text"}, "a resource of the package"),
    "formats/arrays.py": ({"open"}, "a member of an archive that came through the gate"),
    "formats/image_files.py": ({"open"}, "Image.open of an open file; unfinished files of our own"),
    "formats/las.py": ({"open"}, "/dev/null; laspy.open of bytes"),
    "metrics/accumulation.py": ({"load"}, "arrays of our own in a temporary folder"),
    "data/nuscenes_tables.py": ({"open", "load"}, "np.load of an open file; an unfinished file of our own"),
    "formats/torch_files.py": ({"load"}, "torch.load of an open file"),
    "recordings/ros_bags.py": ({"open"}, "a reader's own `open`; rosbags opens by the gate"),
    "recordings/recorded_scans.py": ({"open"}, "a reader's own `open`"),
    "recordings/playback.py": ({"open"}, "a reader's own `open`"),
    "recordings/recorded_images.py": ({"open"}, "a reader's own `open`"),
    "serve/application.py": ({"read_text"}, "a page of the package"),
    "serve/uploads.py": ({"read_bytes", "write_bytes"}, "outputs of our own in a temporary folder"),
    "train/checkpoint.py": ({"open"}, "files of our own, and a folder to lock"),
    "viewer/outputs.py": ({"open"}, "a video to write"),
    "viewer/page.py": ({"open", "load", "read_text"}, "unfinished files of our own; parts of the page"),
    "child_process.py": ({"read_text", "load"}, "/proc; an answer, by a restricted unpickler"),
    "bulk/stores.py": ({"read_bytes"}, "an output of our own, to be uploaded"),
}
READS = {"open", "read_bytes", "read_text", "fromfile", "load_file", "safe_open", "fdopen", "memmap"}
# Libraries that choose a decoder by content, unpack, or could execute: the only file that may call them, and why.
DECODERS = {
    ("Image", "open"): {"formats/image_files.py", "train/latent_frames.py"},  # with their formats
    ("torch", "load"): {"formats/torch_files.py"},  # weights_only, after its own look
    ("np", "load"): {"data/nuscenes_tables.py", "metrics/accumulation.py"},  # allow_pickle=False; our own arrays
    ("pickle", "load"): {"viewer/page.py"},  # our own temporary file
    ("pickle", "loads"): set(),
    ("np", "fromfile"): set(),
    ("np", "loadtxt"): {"formats/delimited_text.py", "data/poses.py"},  # of bounded texts
    ("np", "genfromtxt"): set(),
    ("zlib", "decompress"): set(),  # without a bound on what comes out
    ("gzip", "open"): set(),
    ("gzip", "decompress"): set(),
    ("bz2", "decompress"): set(),
    ("lzma", "decompress"): set(),
    ("yaml", "load"): {"formats/yaml_files.py"},  # a SafeLoader without aliases, of a bounded text
    ("imageio", "imread"): set(),
    ("cv2", "imread"): set(),
    ("h5py", "File"): set(),
    ("av", "open"): {"viewer/outputs.py"},  # to write
    ("feather", "read_table"): {"drives/drive_motion.py"},  # of an open file
    ("shutil", "unpack_archive"): set(),
    ("tarfile", "open"): set(),
    ("os", "system"): set(),
    # Of a bounded message, and of a recipe that was just dumped.
    ("json", "loads"): {"formats/json_files.py", "recordings/point_messages.py", "train/recipe.py"},
    ("json", "load"): set(),
}
WITH_REASON = {"formats/yaml_files.py": {"yaml"}}  # calibrations of cameras and options are written in it
PARSERS = {
    "mmap",  # where somebody cuts a mapped file, the system ends the process
    "h5py",
    "imageio",
    "tifffile",
    "yaml",
    "marshal",
    "shelve",
    "dill",
    "joblib",
    "cloudpickle",
    "xml",
    "tarfile",
}


@functools.cache
def calls(tree: ast.Module) -> list[tuple[str, str, ast.Call]]:
    """Calls as (object's name, method's name, node); ("", name) for plain functions."""
    found = []
    for node in nodes_of(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            owner = node.func.value
            name = owner.id if isinstance(owner, ast.Name) else owner.attr if isinstance(owner, ast.Attribute) else "?"
            found.append((name, node.func.attr, node))
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            found.append(("", node.func.id, node))
    return found


def sources() -> list[tuple[str, ast.Module]]:
    return [(path.as_posix(), tree) for path, tree in parsed(SOURCE)]


def second_doors(trees: list[tuple[str, ast.Module]]) -> list[str]:
    gate = "bounded_files.py"
    own = {("", name) for name in ("read_bytes", "read_text")}  # the gate's functions, imported by name
    return [
        f"{file}:{node.lineno} {name}.{method}"
        for file, tree in trees
        if file != gate
        for name, method, node in calls(tree)
        if method in READS and (name, method) not in own
        if method not in OPENS.get(file, (set(), ""))[0]
    ]


def strange_decoders(trees: list[tuple[str, ast.Module]]) -> list[str]:
    return [
        f"{file}:{node.lineno} {name}.{method}"
        for file, tree in trees
        for name, method, node in calls(tree)
        if file not in DECODERS.get((name, method), {file})
    ]


def test_files_are_opened_by_the_gate_alone():
    assert second_doors(sources()) == []


def test_decoders_are_called_where_their_reason_stands():
    assert strange_decoders(sources()) == []


def test_no_library_that_executes_or_guesses_is_imported():
    for file, tree in sources():
        for node in nodes_of(tree):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            imported = {name.partition(".")[0] for name in names}
            assert PARSERS & imported <= WITH_REASON.get(file, set()), file


@pytest.mark.parametrize(
    ("name", "method", "needed"), [("Image", "open", "formats"), ("torch", "load", "weights_only")]
)
def test_decoders_are_told_what_to_read(name, method, needed):
    found = [node for _, tree in sources() for one, other, node in calls(tree) if (one, other) == (name, method)]
    assert found and all(needed in {word.arg for word in node.keywords} for node in found)


@pytest.mark.parametrize(
    ("line", "find"),
    [
        ("path.open('rb')", second_doors),
        ("open(path)", second_doors),
        ("Path(path).read_bytes()", second_doors),
        ("np.fromfile(path)", second_doors),
        ("Image.open(path)", strange_decoders),
        ("torch.load(path)", strange_decoders),
        ("zlib.decompress(data)", strange_decoders),
    ],
)
def test_the_test_sees_another_door(line, find):
    assert find([("drives/new.py", ast.parse(line))])


def test_the_security_page_names_tests_that_exist():
    """docs/threat_model.md: each point of OWASP ASVS has its test."""
    page = (ROOT / "docs" / "threat_model.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`(test_\w+)`", page))
    files = (ROOT / "tests").rglob("test_*.py")
    defined = {name for file in files for name in re.findall(r"def (test_\w+)", file.read_text(encoding="utf-8"))}
    assert len(named) >= 15 and not named - defined
    assert all((ROOT / path).exists() for path in re.findall(r"`(tests/[\w/.]+)`", page))
