"""Families in folders and on the hub: a hub of this machine serves one, and a recorded one takes one."""

from __future__ import annotations

import functools
import hashlib
import http.server
import inspect
import json
import shutil
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from installed_families import INSTALLED
from lidar2pano.errors import InputError
from lidar2pano.models.card import Card, read_card
from lidar2pano.models.families import families, weight_files
from lidar2pano.models.hub import PAGE, Upload, hub_licence, model_page
from lidar2pano.pipeline import Pipeline, load

hub = pytest.importorskip("huggingface_hub", reason="the hub's library: pip install 'lidar2pano[train]'")
constants = pytest.importorskip("huggingface_hub.constants")
COMMIT = "0123456789abcdef0123456789abcdef01234567"


def header_of(page: str) -> dict:
    """The YAML header of a page."""
    start, header, _ = page.split("---\n", 2)
    assert start == ""
    return yaml.safe_load(header)


class HubHandler(http.server.BaseHTTPRequestHandler):
    """The hub's answers for one public repository, someone/streets, with the files of a folder."""

    def __init__(self, folder: Path, asked: list[str], *arguments) -> None:
        self.folder, self.asked = folder, asked
        super().__init__(*arguments)

    def log_message(self, *_) -> None:
        pass

    def do_HEAD(self) -> None:  # noqa: N802 the base class's name
        self.do_GET()

    def do_GET(self) -> None:  # noqa: N802 the base class's name
        path = self.path.partition("?")[0]
        self.asked.append(path)
        files = sorted(self.folder.iterdir())
        if path.startswith("/api/models/someone/streets/revision/"):
            names = [{"rfilename": file.name} for file in files]
            self.answer(json.dumps({"id": "someone/streets", "sha": COMMIT, "siblings": names}).encode())
        elif path == f"/api/models/someone/streets/tree/{COMMIT}":
            tree = [{"type": "file", "path": f.name, "size": f.stat().st_size, "oid": COMMIT} for f in files]
            self.answer(json.dumps(tree).encode())
        elif path.startswith(f"/someone/streets/resolve/{COMMIT}/"):
            self.answer((self.folder / path.rpartition("/")[2]).read_bytes())
        else:
            self.send_response(404)
            self.send_header("X-Error-Code", "RepoNotFound")
            self.send_header("Content-Length", "0")
            self.end_headers()

    def answer(self, body: bytes) -> None:
        self.send_response(200)
        self.send_header("ETag", f'"{hashlib.sha256(body).hexdigest()}"')
        self.send_header("X-Repo-Commit", COMMIT)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(body)


@pytest.fixture
def served(random_weights, tmp_path, monkeypatch):
    """The addresses that a hub with a repository of random weights was asked for."""
    folder, asked = tmp_path / "repository", []
    shutil.copytree(random_weights, folder)
    (folder / "pytorch_model.bin").write_bytes(b"a pickle")
    (folder / PAGE).write_text("# Streets\n")
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(HubHandler, folder, asked))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    address = f"http://127.0.0.1:{server.server_port}"
    monkeypatch.setattr(constants, "ENDPOINT", address)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", address + "/{repo_id}/resolve/{revision}/{filename}")
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_PROGRESS_BARS", True)
    yield asked
    server.shutdown()
    thread.join()
    server.server_close()


def sums(pipeline: Pipeline) -> dict[str, str]:
    return {role: card.sha256 for role, card in pipeline.cards.items()}


def test_a_family_comes_from_the_hub_without_its_pickle(served, random_weights, tmp_path):
    cache = tmp_path / "cache"
    pipeline = Pipeline.from_pretrained("someone/streets", cache_dir=cache, token=False, device="cpu")
    assert sums(pipeline) == sums(load(random_weights, "cpu"))
    assert not any("pytorch_model.bin" in path for path in served)
    served.clear()
    again = Pipeline.from_pretrained("someone/streets", cache_dir=cache, local_files_only=True, device="cpu")
    assert sums(again) == sums(pipeline) and served == []


def test_a_repository_that_is_not_there_is_one_line(served, tmp_path):
    with pytest.raises(
        InputError, match=r"^someone/nothing: cannot be fetched from the hub \(.*\); give a folder$"
    ) as e:
        Pipeline.from_pretrained("someone/nothing", cache_dir=tmp_path, token=False)
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("name", ["someone/streets", "a--b/c", "a/.."])
def test_without_a_network_one_line_says_to_give_a_folder(name, tmp_path, monkeypatch):
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(InputError, match=r"; give a folder$") as caught:
        Pipeline.from_pretrained(name, cache_dir=tmp_path / "cache", token=False)
    assert "\n" not in str(caught.value)


def test_without_the_library_one_line_says_to_give_a_folder(monkeypatch, random_weights, tmp_path):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    pipeline = Pipeline.from_pretrained(random_weights, device="cpu")
    with pytest.raises(InputError, match=r"^someone/streets: no such folder, .* or give a folder$"):
        Pipeline.from_pretrained("someone/streets")
    with pytest.raises(InputError, match=r"^someone/streets: .*pip install"):
        pipeline.push_to_hub("someone/streets")


def test_what_is_no_name_of_a_repository_is_a_folder_or_a_family(random_weights):
    with pytest.raises(InputError, match="neither a released family nor a file"):
        Pipeline.from_pretrained("/no/such/folder")
    with pytest.raises(InputError, match="did you mean 'world'"):
        Pipeline.from_pretrained("wrld")
    with pytest.raises(InputError, match="no weights for the translator and the painter"):
        Pipeline.from_pretrained(random_weights / "segmenter.safetensors", device="cpu")
    assert Pipeline.from_pretrained("world", device="cpu").files == weight_files("world")


def test_what_is_saved_is_what_was_loaded(random_weights, tmp_path):
    source, out = tmp_path / "source", tmp_path / "my-streets"
    shutil.copytree(random_weights, source)
    (source / "LICENSE").write_text("mine\n")
    assert load(source, "cpu").save_pretrained(out) is None
    names = sorted(path.name for path in source.glob("*.safetensors"))
    assert sorted(path.name for path in out.iterdir()) == sorted([*names, "LICENSE", PAGE, "scores.json"])
    assert all((out / name).read_bytes() == (source / name).read_bytes() for name in [*names, "LICENSE"])
    page = (out / PAGE).read_text()
    assert header_of(page)["license"] == "cc-by-nc-sa-4.0" and "# my-streets" in page
    (out / PAGE).write_text("my own words")
    Pipeline.from_pretrained(out, device="cpu").save_pretrained(out)
    assert (out / PAGE).read_text() == "my own words"
    assert sums(Pipeline.from_pretrained(out, device="cpu")) == sums(load(random_weights, "cpu"))


def test_parts_of_several_folders_keep_their_licences(random_weights, tmp_path):
    for name in ("a", "b"):
        shutil.copytree(random_weights, tmp_path / name)
        (tmp_path / name / "LICENSE").write_text(name)
    load(f"{tmp_path / 'a'}+{tmp_path / 'b' / 'painter.safetensors'}", "cpu").save_pretrained(tmp_path / "out")
    assert (tmp_path / "out" / "LICENSE-segmenter-translator").read_text() == "a"
    assert (tmp_path / "out" / "LICENSE-painter").read_text() == "b"


def test_weights_that_changed_or_are_others_are_not_mixed(random_weights, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(random_weights, source)
    pipeline = load(source, "cpu")
    (tmp_path / "others").mkdir()
    shutil.copy(random_weights / "painter.safetensors", tmp_path / "others" / "day.safetensors")
    with pytest.raises(InputError, match=r"holds other weights \(day.safetensors\); choose another folder"):
        pipeline.save_pretrained(tmp_path / "others")
    shutil.copy(families()["world"] / "painter.safetensors", source / "painter.safetensors")
    with pytest.raises(InputError, match=r"painter.safetensors: has changed since it was loaded"):
        pipeline.save_pretrained(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_upload_has_the_files_of_a_folder(random_weights, tmp_path, monkeypatch):
    calls = []

    class Api:
        def __init__(self, token=None):
            calls.append(("token", token))

        def create_repo(self, repo_id, **options):
            calls.append((repo_id, options))
            return SimpleNamespace(repo_id=repo_id)

        def upload_folder(self, folder_path, **options):
            calls.append((sorted(path.name for path in Path(folder_path).iterdir()), options))
            return "https://hub/commit/1"

    monkeypatch.setattr(hub, "HfApi", Api)
    pipeline = load(random_weights, "cpu")
    address = pipeline.push_to_hub("someone/streets", private=True, token="t", branch="b", ignore_patterns="*.md")
    files = sorted([PAGE, "scores.json", *(path.name for path in random_weights.glob("*.safetensors"))])
    assert address == "https://hub/commit/1" and calls == [
        ("token", "t"),
        ("someone/streets", {"private": True, "exist_ok": True}),
        (
            files,
            {
                "repo_id": "someone/streets",
                "repo_type": "model",
                "revision": "b",
                "commit_message": "Push model using huggingface_hub.",
                "ignore_patterns": "*.md",
            },
        ),
    ]
    assert pipeline.save_pretrained(tmp_path / "out", push_to_hub=True) == address and calls[-1][0] == files
    monkeypatch.undo()
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(InputError, match=r"^someone/streets: cannot be uploaded .*; save_pretrained\(folder\) writes"):
        pipeline.push_to_hub("someone/streets", token="t")


def keywords(function) -> set[str]:
    parameters = inspect.signature(function).parameters.values()
    return {parameter.name for parameter in parameters if parameter.kind != parameter.VAR_KEYWORD} - {"self"}


def test_the_keywords_are_those_of_the_hubs_mixin():
    theirs = hub.ModelHubMixin
    assert keywords(theirs.from_pretrained) < keywords(Pipeline.from_pretrained)
    without = {"config", "model_card_kwargs"}  # a weight file's card is its only configuration
    assert keywords(theirs.save_pretrained) - without == keywords(Pipeline.save_pretrained)
    assert keywords(theirs.push_to_hub) - without == keywords(Pipeline.push_to_hub) | Upload.__annotations__.keys()


@pytest.mark.parametrize("family", INSTALLED)
def test_a_released_family_has_its_page(family):
    cards = {role: read_card(file) for role, file in weight_files(family).items()}
    page = (families()[family] / PAGE).read_text(encoding="utf-8")
    assert page == model_page(family, cards), "run runs/card_scores.py"
    header = header_of(page)
    assert header["library_name"] == "lidar2pano" and header["license"] == cards["painter"].licence.lower()
    assert {"mean_iou", "ssim"} <= set(header["metrics"]) and header["datasets"] and "lidar" in header["tags"]
    data = hub.ModelCard.load(families()[family] / PAGE).data  # the hub's own reader
    assert data.license == header["license"] and data.datasets == header["datasets"]


def test_a_licence_that_the_hub_does_not_name_is_other():
    assert hub_licence(["Apache-2.0", "Apache-2.0"]) == {"license": "apache-2.0"}
    assert hub_licence(["MIT for the code"]) == {"license": "other", "license_name": "MIT for the code"}
    assert hub_licence(["MIT", ""]) == {"license": "other", "license_name": "MIT; not stated"}
    page = model_page("a: b", {"painter": Card(network="latent-painter", data='x"y+z')})
    assert header_of(page)["datasets"] == ['x"y', "z"] and header_of(page)["license_name"] == "not stated"
