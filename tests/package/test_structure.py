"""The house rules over the package; and, for each, a small bad tree on which it must bite."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import house_rules
import lidar2pano
from lidar2pano.models import MODELS

NETWORKS = {network.__name__ for network in MODELS.values()}
CONFIGS = [house_rules.SOURCE / "train" / name for name in ("recipe.py",)]
CONFIGS += [
    path for path in (house_rules.SOURCE / "train").glob("*.py") if "(TaskOptions):" in path.read_text(encoding="utf-8")
]
HEAVY = (
    "torch",
    "lightning_fabric",
    "torchmetrics",
    "tensorboard",
    "transformers",
    "cv2",
    "matplotlib",
    "scipy",
    "skimage",
)
# What is imported where it is needed, and not for the panorama of a scan file.
IDLE = ("openvino", "onnx", "onnxruntime", "torch._dynamo", "torch._inductor", "sympy", "numpy.ma", "scipy", "rosbags")
IDLE += (
    "mcap",
    "velodyne_decoder",
    "laspy",
    "pyarrow",
    "kiss_icp",
    "rich.progress",
    "starlette",
    "fsspec",
    "matplotlib",
)
PROMISED = {"demo", "translate", "world", "prepare", "train", "evaluate", "reproduce", "weights", "bench"}
PROMISED |= {"bulk", "serve"}
MOST_SECONDS = 1.0

# Runs the help of every command in one process; the last line it prints is JSON.
ALL_HELP = """
import contextlib, io, json, sys, typer.main
from lidar2pano.cli import app

def walk(command, words):
    yield words
    for name, inner in getattr(command, "commands", {}).items():
        yield from walk(inner, [*words, name])

command, texts = typer.main.get_command(app), {}
for words in walk(command, []):
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        command.main([*words, "--help"], prog_name="lidar2pano")
    texts[" ".join(words)] = text.getvalue()
print(json.dumps({"texts": texts, "modules": sorted({name.partition(".")[0] for name in sys.modules})}))
"""


@pytest.fixture
def tree(tmp_path):
    """A function that writes a small package: relative path -> text."""

    def write(**files: str) -> Path:
        for name, text in files.items():
            path = tmp_path.joinpath(*name.split("__")).with_suffix(".py")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return tmp_path

    return write


# --- floors ---------------------------------------------------------------------------------------------------------


def test_nothing_imports_upwards():
    assert house_rules.climbs(house_rules.SOURCE) == []


@pytest.mark.parametrize(
    ("importer", "statement", "complaint"),
    [
        ("models__titan", "from lidar2pano.pipeline import load", "floor 3 may not know floor 4"),
        ("scan", "def later():\n    import lidar2pano.geometry.knn", "floor 0 may not know floor 1"),
        ("geometry__knn", "from ..train import engine", "floor 1 may not know floor 6"),
        ("losses", "from lidar2pano import metrics", "floor 3 may not know floor 3"),
        ("errors", "from lidar2pano.scan import Scan", "floor -1 may not know floor 0"),
        ("evaluate", "from lidar2pano import read", "import from the module itself"),
        ("pipeline", "from lidar2pano.cli_demo import demo", "floor 4 may not know floor 8"),
        ("odd", "import math", "'odd' is on no floor; enter it in FLOORS"),
        ("pipeline", "from lidar2pano.odd import x", "'odd' is on no floor"),
    ],
)
def test_climbing_is_found(tree, importer, statement, complaint):
    others = ("pipeline", "geometry__knn", "train__engine", "metrics____init", "cli_demo", "scan")
    source = tree(**dict.fromkeys(others, ""), **{"formats__kitti": "from lidar2pano.scan import Scan"})
    (source / "metrics" / "__init__.py").write_text("")
    assert house_rules.climbs(source) == []
    (fault,) = [line for line in house_rules.climbs(tree(**{importer: statement})) if complaint in line]
    assert fault.startswith(importer.replace("__", "/"))


def test_what_floors_allow(tree):
    source = tree(
        errors="import difflib",
        scan="from lidar2pano.errors import InputError",
        formats__kitti="from lidar2pano.scan import Scan",
        models__salsanext="import torch",
        models__titan="from lidar2pano.models.salsanext import Trunk\nfrom .salsanext import Trunk as same",
        models__card="from lidar2pano import __version__",
        cli="from lidar2pano.cli_train import app\nimport lidar2pano",
        cli_train="from lidar2pano import read",
    )
    assert house_rules.climbs(source) == []


def test_no_files_import_each_other_in_a_circle():
    assert house_rules.circles(house_rules.SOURCE) == []


def test_a_circle_is_found(tree):
    source = tree(
        scan="import math",
        formats__pcd="from lidar2pano.formats.ply import x\nfrom lidar2pano.scan import Scan",
        formats__ply="def later():\n    from lidar2pano.formats import las",
        formats__las="from .pcd import y",
        models__card="if TYPE_CHECKING:\n    from lidar2pano.models.titan import Titan",
        models__titan="from lidar2pano.models.card import Card",
    )
    assert house_rules.circles(source) == [
        "formats/las.py and formats/pcd.py and formats/ply.py import each other in a circle"
    ]


def test_floor_0_knows_numpy_only():
    assert house_rules.foreign(house_rules.SOURCE) == []


def test_a_foreign_package_on_floor_0_is_found(tree):
    source = tree(
        scan="import numpy as np\nimport json", labels="def f():\n    from torch import nn", losses="import torch"
    )
    assert house_rules.foreign(source) == ["labels.py imports torch.nn: floor 0 knows numpy and the standard library"]


def test_floor_0_loads_without_torch():
    names = ", ".join(f"lidar2pano.{name}" for name in sorted(house_rules.FLOORS[0] | house_rules.ANYWHERE))
    code = f"import sys, lidar2pano, {names}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- sizes, names, noise, builders ----------------------------------------------------------------------------------


def test_functions_stay_small():
    assert house_rules.too_big(house_rules.SOURCE) == []


def test_big_things_are_found(tree):
    body = "    x = 1\n"
    source = tree(
        tall="def f():\n" + body * 60,
        wide="class A:\n    def f(self, a, b, c, d, e, f, *, g, h, i): ...",
        fine="x = 1\n" * 239 + "class A:\n    def f(self, a, b, c, d, e, f, *, g, h):\n" + ("    " + body) * 59,
        cli="@app.command()\ndef f(a, b, c, d, e, f, g, h, i): ...",  # options of a command are no parameters
    )
    assert house_rules.too_big(source) == [
        "tall.py:1 f has 61 lines (limit 60)",
        "wide.py:2 f takes 9 parameters (limit 8)",
    ]


def test_names_say_contents():
    assert house_rules.empty_names(house_rules.SOURCE) == []


def test_empty_names_are_found(tree):
    source = tree(core__titan="", models__train_utils="", commonplace="", database="")
    assert house_rules.empty_names(source) == [
        "core/titan.py: the name says nothing",
        "models/train_utils.py: the name says nothing",
    ]


def test_no_two_files_share_a_name():
    assert house_rules.repeated_names(house_rules.SOURCE) == []


def test_every_exception_for_repeated_names_is_needed(tree):
    assert house_rules.idle_exceptions(house_rules.SOURCE) == []
    assert "surfaces.py" in house_rules.idle_exceptions(tree(scene__surfaces=""))


def test_a_repeated_name_is_found(tree):
    source = tree(models__card="", evaluate__card="", cli__card="")
    (source / "models" / "__init__.py").write_text("")
    (source / "evaluate" / "__init__.py").write_text("")
    assert house_rules.repeated_names(source) == ["evaluate/card.py and models/card.py are called alike"]


def test_only_the_door_speaks():
    assert house_rules.noisy(house_rules.SOURCE) == []


def test_noise_is_found(tree):
    noise = "print(1)\nconsole.print(2)\nsys.exit(3)\nlogging.basicConfig()\nlog.info(4)\nprinted(5)"
    found = house_rules.noisy(tree(losses=noise, cli=noise, cli_world=noise))
    assert [line.split(":")[1] for line in found] == [
        "1 calls print",
        "2 calls console.print",
        "3 calls sys.exit",
        "4 calls logging.basicConfig",
    ]


def test_networks_have_one_builder():
    assert {"SalsaNext", "Titan", "TitanCritic"} <= NETWORKS
    assert house_rules.second_builders(house_rules.SOURCE, NETWORKS) == []


def test_a_second_builder_is_found(tree):
    source = tree(models__titan="Titan()", pipeline="titan.Titan(classes=15)", evaluate="Titan: object\nbuild('titan')")
    assert house_rules.second_builders(source, {"Titan"}) == ["pipeline.py:1 constructs Titan: call models.build"]


# --- configuration --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("configs", CONFIGS, ids=lambda path: path.stem)
def test_every_config_field_is_read(configs):
    assert "@dataclass" in configs.read_text(encoding="utf-8")
    assert house_rules.unread(configs, house_rules.SOURCE) == []


@pytest.mark.parametrize(
    ("configs", "readers", "read", "field"),
    [
        ("recipe.py", "*.py", "data.train", "Data.train"),
        ("recipe.py", "*.py", "recipe.view", "Recipe.view"),
        ("recipe.py", "*.py", "settings.algorithm", "Optimizer.algorithm"),
        ("segmentation.py", "*.py", "options.dropout", "SegmentationOptions.dropout"),
        ("front.py", "front.py", "options.depth", "FrontDepthOptions.depth"),
        ("autoencoding.py", "autoencoding.py", "options.pixels", "AutoencodingOptions.pixels"),
    ],
)
def test_a_field_counts_by_its_class_and_not_by_its_name(tmp_path, configs, readers, read, field):
    """Without the reads of one class's field, those of another class's field of that name do not count."""
    source = tmp_path / "train"
    source.mkdir()
    for path in (house_rules.SOURCE / "train").glob("*.py"):
        text = path.read_text(encoding="utf-8")
        unread = text.replace(read, f"{read}_") if path.match(readers) else text
        source.joinpath(path.name).write_text(unread, encoding="utf-8")
    elsewhere = f"def read(frame):\n    return frame.{field.rpartition('.')[2]}\n"
    source.joinpath("elsewhere.py").write_text(elsewhere, encoding="utf-8")
    assert house_rules.unread(source / configs, source) == [f"{field} is read nowhere"]


def test_an_unread_field_is_found(tree):
    source = tree(
        train__recipes=(
            "@dataclass(frozen=True, kw_only=True)\nclass Training:\n"
            "    steps: int = 1\n    rate: float = 0.1\n    KINDS: ClassVar[int] = 2\n"
            "@dataclass\nclass Recipe:\n    training: Training\n    name: str\n    view: str\n"
            "class Plain:\n    free: int = 3\n"
        ),
        train__engine=(
            "def run(recipe: Recipe, frame):\n    recipe.training.rate = 2\n    frame.view\n"
            "    return recipe.training.steps, recipe.name\n"
        ),
    )
    unread = house_rules.unread(source / "train" / "recipes.py", source)
    assert unread == ["Training.rate is read nowhere", "Recipe.view is read nowhere"]


# --- the public names -----------------------------------------------------------------------------------------------


def test_public_names_are_the_recorded_ones():
    recorded = house_rules.INVENTORY.read_text(encoding="utf-8")
    assert house_rules.inventory() == recorded, "if the change is meant: .venv/bin/python tests/support/house_rules.py"


def test_a_changed_signature_changes_the_inventory(monkeypatch):
    before = house_rules.inventory()
    assert "def read(source: Any, overrides: Overrides | None = None) -> Scan\n" in before
    assert "View(*, rows: int, columns: int, up: float, down: float" in before
    assert "\n    scaled(self, factor: float) -> View\n" in before
    monkeypatch.setattr(lidar2pano, "read", lambda path, strict: None)
    assert "def read(path, strict)\n" in house_rules.inventory()


def test_the_package_costs_nothing_until_a_name_is_used():
    code = "import sys, lidar2pano; lidar2pano.VIEWS; sys.exit('torch' in sys.modules or 'PIL' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_unknown_names_are_refused():
    assert set(lidar2pano.__all__) <= set(dir(lidar2pano))
    with pytest.raises(AttributeError, match="'lidar2pano' has no attribute 'Sacn'"):
        lidar2pano.__getattr__("Sacn")


# --- the command line's door ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def helps() -> dict:
    """The help of every command, and the modules that were imported for it."""
    done = subprocess.run([sys.executable, "-c", ALL_HELP], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_help_imports_nothing_heavy(helps):
    assert [name for name in HEAVY if name in helps["modules"]] == []


def test_every_promised_command_explains_itself(helps):
    assert set(helps["texts"]) >= PROMISED
    silent = [name for name, text in helps["texts"].items() if "Usage" not in text or len(text.splitlines()) < 5]
    assert silent == []


@pytest.fixture(scope="module")
def loaded() -> tuple[set[str], set[str]]:
    """What is imported to translate, and then to train as well."""
    code = "import sys, lidar2pano.cli.batch; print(*sys.modules); import lidar2pano.train.engine; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    translating, training = done.stdout.splitlines()
    return set(translating.split()), set(training.split())


def test_translating_imports_nothing_that_one_scan_has_no_use_for(loaded):
    assert "torch" in loaded[0]
    assert [name for name in IDLE if name in loaded[0]] == []


def test_training_does_without_torchmetrics(loaded):
    assert "lidar2pano.train.engine" in loaded[1]
    assert {"torchmetrics", "transformers", "scipy"} & loaded[1] == set()


def cpu_seconds(code: str) -> float:
    """User and system time of one `python -c code`, which must succeed."""
    before = os.times()
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    after = os.times()
    return after.children_user - before.children_user + after.children_system - before.children_system


def test_cpu_seconds_measures_the_child():
    assert 0.25 < cpu_seconds("import time\nwhile time.process_time() < 0.3: pass") < 0.3 + MOST_SECONDS


def test_help_takes_less_than_a_second():
    code = "import sys; sys.argv = ['lidar2pano', '--help']; from lidar2pano.cli import main; main()"
    assert any(cpu_seconds(code) < MOST_SECONDS for _ in range(3))
