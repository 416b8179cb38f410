"""Every shell line of README, the quick start and the guides, typed as it stands, on the released families.

`make test-released` runs it. Each line runs in a folder with all that pages mention (`workshop`); README's, which
have every command, once more with the other installed families. A line that trains or times for long is shortened by
ABRIDGED; a line that no test can run is in NOT_RUN with its reason.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import lidar2pano
from documented import PAGES, TASKS, Line, blocks, shell_lines
from house_rules import ROOT
from installed_families import INSTALLED
from lidar2pano.cli import main
from lidar2pano.models.families import best_family

released = pytest.mark.released
LINES = [line for page in TASKS for line in shell_lines(page, PAGES[page])]

NOT_RUN = {  # beginning of a line -> why no test types it
    "python -m venv": "makes the environment that the tests run in",
    "git clone": "there is no network",
    "pip install": "installs from an index; `make setup-dev` has installed all extras",
    "conda create": "likewise",
    "uv venv": "likewise",
    "make ": "is this run, or has a job of its own in .ci/run",
    "docker ": "no Docker here",
    "source /opt/ros": "no ROS here",
    "python3 -m venv": "likewise; no ROS here, tests/examples/test_ros_node.py has stand-ins",
    "colcon build": "likewise",
    "ros2 launch": "likewise",
    "rerun ": "opens a window",
    "python runs/serve_load.py": "loads a server for a minute; by hand",
    "lidar2pano bulk /data/drives --out /data/panoramas --ray head:6379": "no cluster here",
    "lidar2pano evaluate streets --data data/pandaset": "PandaSet does not ship; tests/evaluate has a small one",
    "lidar2pano evaluate streets 'OUT/levels": "needs hours of training; tests/evaluate/test_folds.py",
    "python runs/cross_validation.py": "trains for hours; tests/train/test_cross_validation.py",
    "lidar2pano prepare ROOT --lidar none --teacher mask2former:PATH": "the teacher's weights do not ship",
    "lidar2pano prepare ROOT --teacher": "no camera teacher ships; tests/prepare has small ones",
    "lidar2pano train sdnet --data CITYSCAPES": "Cityscapes does not ship; tests/docs/test_semantic_kitti.py",
    "lidar2pano train vid2vid --data CITYSCAPES": "Cityscapes does not ship; tests/train/test_video_task.py",
    "lidar2pano train autoencoder --data KITTI": "KITTI does not ship; tests/train/test_latent_painting.py",
    "lidar2pano train latent-painter --data KITTI": "KITTI does not ship; tests/train/test_latent_painting.py",
    "lidar2pano train latent-texture --data KITTI": "KITTI does not ship; tests/train/test_latent_painting.py",
    "python -c 'import wandb": "logs in to a service",
    "lidar2pano train salsanext --data ROOT": "an epoch takes hours; tests/train/test_tasks.py has small networks",
    "lidar2pano weights import vid2vid": "its files do not ship; tests/docs/test_semantic_kitti.py has small ones",
    "lidar2pano translate scan.bin --weights salsanext.safetensors+titan.safetensors+": "needs vid2vid's files",
}
ABRIDGED = {  # words of a line ($: its end) -> words in their place
    "--sequences 10 --frames 20": "--sequences 1 --frames 1 --view panorama/4",
    "--sequences 4 --frames 20": "--sequences 1 --frames 1 --view panorama/4",
    "training.minutes=60": "training.steps=1 --set training.batch=1 --set training.workers=0",
    "fast-segmenter-mini --data ROOT": "fast-segmenter-mini --data ROOT --set training.steps=1 --set training.batch=1 "
    "--set training.workers=0",
    "lidar2pano bench": "lidar2pano bench --runs 1",
    "--budget 20m": "--budget 1steps --rows scunet --frames 1 --set scunet.training.batch=1 "
    "--set scunet.training.workers=0",
    "--rows titan,pix2pix": "--rows titan,pix2pix --budget 1steps --frames 1",
    "reproduce --data ROOT --out DIR$": "reproduce --data ROOT --out DIR --budget 1steps --frames 1",
    "/data/": "data/",
    "FAMILY/": f"{ROOT}/src/lidar2pano/weights/world/",
    "--shard $SLURM_ARRAY_TASK_ID/64": "--shard 0/1",
    "--shard $JOB_COMPLETION_INDEX/64": "--shard 0/1",
    "CUDA_VISIBLE_DEVICES=$LOCAL_RANK lidar2pano": "lidar2pano",
    "--shard $RANK/$WORLD_SIZE": "--shard 0/1",
}
OF_DATA = ("--data ROOT", "prepare ROOT")  # lines that read the simulated world of `data_set`
SERVES = "lidar2pano serve"
TAKE_A_FAMILY = ("translate", "view", "bulk", "serve", "export")


def others() -> list[str]:
    """Return the installed families that are not the default."""
    return [name for name in INSTALLED if name != best_family()]


def reason(line: Line) -> str | None:
    """Return why a line is not run, or None."""
    return next((why for start, why in NOT_RUN.items() if line.text.startswith(start)), None)


def abridged(text: str) -> str:
    text += "$"
    for long, short in ABRIDGED.items():
        text = text.replace(long, short)
    return text.removesuffix("$")


def families_of(line: Line) -> list[str]:
    """Return the families that a line runs with: the default one, and README's lines, if they name none, all others."""
    words = line.words
    takes = (
        line.page == "README.md"
        and words[0] == "lidar2pano"
        and len(words) > 1
        and words[1] in TAKE_A_FAMILY
        and "--weights" not in words
    )
    return ["", *others()] if takes else [""]


# A line that several pages have runs once, and so does an export, wherever its graphs go.
RUN = {
    (re.sub(r"--onnx \S+", "", line.text), family): (line, family)
    for line in reversed(LINES)  # README last: its lines stay
    if not reason(line)
    for family in families_of(line)
}


def parameters() -> list:
    """One parameter per line and family; lines that share the simulated world or a port stay in one worker."""
    marked = []
    for line, family in RUN.values():
        group = "data" if any(text in line.text for text in OF_DATA) else f"{line.page}{line.text}{family}"
        label = f"{line.page.removeprefix('docs/')}: {line.text}" + (f" ({family})" if family else "")
        marked.append(pytest.param(line, family, id=label, marks=pytest.mark.xdist_group(group)))
    return marked


# --- quick: what is in the tables is in the documentation -----------------------------------------------------------


def test_every_exception_is_a_line_of_the_documentation():
    texts = [line.text for line in LINES]
    assert [start for start in NOT_RUN if not any(text.startswith(start) for text in texts)] == []
    assert [long for long in ABRIDGED if not any(long in f"{text}$" for text in texts)] == []


def test_most_lines_are_run():
    assert len(RUN) > 40
    assert {"README.md", "docs/start.md", "docs/guides/translate.md"} <= {line.page for line, _ in RUN.values()}


# --- make test-released ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def workshop(tmp_path_factory) -> Path:
    from workshop import write_workshop

    return write_workshop(tmp_path_factory.mktemp("workshop"))


@pytest.fixture(scope="session")
def data_set(tmp_path_factory) -> Path:
    """A simulated data set of two sequences of one frame."""
    root = tmp_path_factory.mktemp("data") / "ROOT"
    assert main(["world", str(root), "--sequences", "2", "--frames", "1", "--view", "panorama/4"]) == 0
    return root


@pytest.fixture
def bench(workshop, tmp_path, monkeypatch) -> Path:
    """An own copy of the workshop, as the working folder."""
    folder = tmp_path / "here"
    shutil.copytree(workshop, folder, copy_function=os.link)
    monkeypatch.chdir(folder)
    return folder


def prepare_inputs(line: Line, folder: Path, family: str) -> None:
    """Make what a line reads and an earlier one on its page has made."""
    from workshop import write_published

    if "SalsaNext" in line.text or "titan.pth" in line.text or "salsanext.safetensors" in line.text:
        write_published(folder)
    if "salsanext.safetensors" in line.text and " import " not in line.text:
        assert main(["weights", "import", "SalsaNext", "--as", "salsanext", "--out", "salsanext.safetensors"]) == 0
    if line.words[1:3] == ["view", "panoramas/"]:
        chosen = ["--weights", family] if family else []
        assert main(["translate", "scan.bin", "--save", "all", *chosen]) == 0


@released
@pytest.mark.parametrize(
    ("line", "family"), [p for p in parameters() if not p.values[0].text.startswith(("curl", SERVES))]
)
def test_documented_line(line, family, bench, request, capfd):
    if any(text in line.text for text in OF_DATA):
        shutil.copytree(request.getfixturevalue("data_set"), bench / "ROOT")
    prepare_inputs(line, bench, family)
    words = line._replace(text=abridged(line.text)).words
    assert words[0] == "lidar2pano", f"no test types {words[0]!r}: run it, or enter it in NOT_RUN with the reason"
    if family:
        words = [family if word == "streets" else word for word in words]
        words += ["--weights", family] if words[1] != "export" else []
    run = follow if "--follow" in words else in_a_child if "--ray" in words else main
    code = run(words[1:])
    printed = capfd.readouterr()
    assert code == 0, printed.err
    if words[1] == "export":
        assert_any_batch(Path(words[words.index("--onnx") + 1]))
    assert [name for name in line.promised_files if not (bench / name).stat().st_size] == []
    for image in bench.glob("panoramas/*.png"):
        with Image.open(image) as opened:
            assert opened.size[0] > 1


def assert_any_batch(graphs: Path) -> None:
    """ONNX Runtime loads all graphs, and their batch is free."""
    import onnxruntime

    files = sorted(graphs.glob("*.onnx"))
    assert len(files) >= 3
    for file in files:
        session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
        assert not isinstance(session.get_inputs()[0].shape[0], int), file.name


def in_a_child(words: list[str]) -> int:
    """Run a command in a process of its own: Ray leaves processes to the one that starts it."""
    return subprocess.run([sys.executable, "-m", "lidar2pano", *words], check=False).returncode


def follow(words: list[str]) -> int:
    """Run `translate --follow` until it has written one panorama, and interrupt it."""
    with subprocess.Popen([sys.executable, "-m", "lidar2pano", *words]) as process:
        end = time.monotonic() + 120
        while not any(Path("out").glob("*.png")) and time.monotonic() < end and process.poll() is None:
            time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        return process.wait(60)


@contextlib.contextmanager
def server(family: str) -> Iterator[str]:
    """Run `lidar2pano serve` on a free port; yields its address."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    words = ["serve", "--port", str(port), *(["--weights", family] if family else [])]
    with subprocess.Popen([sys.executable, "-m", "lidar2pano", *words], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        yield process.stdout.readline().strip()
        process.terminate()
        assert process.wait(60) == 0


@released
@pytest.mark.parametrize("family", ["", *others()])
def test_the_server_answers_the_documented_request(bench, family):
    (line,) = [line for line in LINES if line.text.startswith("curl ")]
    address = "http://127.0.0.1:8360"
    with server(family) as own_address:
        assert urllib.request.urlopen(f"{own_address}/", timeout=60).status == 200
        if shutil.which("curl"):
            subprocess.run(line._replace(text=line.text.replace(address, own_address)).words, check=True, timeout=120)
        else:
            request = urllib.request.Request(f"{own_address}/panorama", (bench / "scan.bin").read_bytes())
            (bench / "panorama.png").write_bytes(urllib.request.urlopen(request, timeout=120).read())
    with Image.open(bench / "panorama.png") as image:
        assert image.size == (4608, 384)


@released
@pytest.mark.filterwarnings("ignore:.torch.jit.script_method. is deprecated:DeprecationWarning")  # torch's own
@pytest.mark.parametrize("family", INSTALLED)
@pytest.mark.parametrize(
    "engine",  # both families' networks are alike: what is compiled for one, the next in the same worker has
    ["torch", pytest.param("compile", marks=pytest.mark.xdist_group("compile")), "onnx", "openvino"],
)
def test_every_output_by_every_engine(bench, family, engine):
    if engine == "compile" and not shutil.which(os.environ.get("CXX", "g++")):
        pytest.skip("torch.compile needs a C++ compiler")
    save = "rgb,segments,labels,depth,confidence,measured,remission,range"
    words = ["scan.bin", "--weights", family, "--engine", engine, "--save", save, "--ply", "--view", "--out", "out"]
    assert main(["translate", *words]) == 0
    endings = ("png", "segments.png", "label", "depth.png", "confidence.png", "measured.png", "ply")
    assert [ending for ending in endings if not (bench / "out" / f"scan.{ending}").exists()] == []


@released
@pytest.mark.parametrize("family", INSTALLED)
def test_two_workers_of_bulk(bench, family):
    pytest.importorskip("ray", reason="workers are Ray's: the extra 'bulk'")
    words = ["bulk", "SCANS", "--out", "DIR", "--weights", family, "--ray", "--workers", "2", "--cores", "1"]
    done = subprocess.run([sys.executable, "-m", "lidar2pano", *words], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert {path.relative_to("DIR").as_posix() for path in Path("DIR").rglob("*.png")} == {
        "town/000000.png",
        "000001.png",
    }


PYTHON_PAGES = [page for page in TASKS if "```python" in PAGES[page]]


@released
@pytest.mark.parametrize("family", INSTALLED)
@pytest.mark.parametrize("page", PYTHON_PAGES)
def test_documented_python(page, family, bench):
    import miniature_recordings as recordings

    scan = lidar2pano.read("scan.bin")
    message = recordings.message(recordings.points(scan, recordings.START_NS), recordings.ROS2)
    names: dict[str, object] = {"points": np.fromfile("scan.bin", np.float32).reshape(-1, 4), "message": message}
    names |= {"o3d_cloud": SimpleNamespace(points=scan.xyz), "pipeline": lidar2pano.load(family)}
    for block in blocks(PAGES[page], "python"):
        code = block.replace('load("streets")', f'load("{family}")').replace("load()", f'load("{family}")')
        exec(compile(code, page, "exec"), names)
    assert any(name in names for name in ("panorama", "scan")), sorted(names)
