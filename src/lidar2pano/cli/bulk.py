"""lidar2pano bulk."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from typer.core import TyperCommand

from lidar2pano.cli import options as opt
from lidar2pano.cli.app import TERMINATED, app
from lidar2pano.cli.console import bar, print_error, print_note, print_weights, until_signal
from lidar2pano.errors import InputError, closest

if TYPE_CHECKING:
    from lidar2pano.bulk import Entry, Job, Manifest, Shard
    from lidar2pano.cli.batch import Options

# (job, scans, whether to stop) -> the manifest's lines
Translate = Callable[["Job", "list[Entry]", Callable[[], bool]], Iterable[dict[str, Any]]]
CORES = 2  # of a worker of Ray
BAD_SCANS = 3  # exit code: some scans failed

RootArgument = Annotated[
    str,
    typer.Argument(
        metavar="ROOT", help="Folder, or URL: all scans and recordings below it are translated; or a recording."
    ),
]
ShardOption = Annotated[
    str, typer.Option(metavar="I/N", help="Only the scans of shard I of N; I counts from 0 to N - 1.")
]
SaveOption = Annotated[
    str,
    typer.Option(
        metavar="LIST", help="Outputs: rgb, segments, labels, depth or all (rgb; with --as: rgb, segments, depth)."
    ),
]
LayoutOption = Annotated[
    str, typer.Option("--as", metavar="NAME", help="Lay panoramas out as a data set: semantickitti.")
]
LabelsOption = Annotated[
    bool, typer.Option("--labels", help="Paint the scans' own labels (.label) instead of the segmenter's.")
]
AddressOption = Annotated[
    str,
    typer.Option(
        "--ray", metavar="[ADDRESS]", help="Work on a Ray cluster: this one, or one that is found or started."
    ),
]
WorkersOption = Annotated[
    int, typer.Option(min=0, metavar="N", help="With --ray: how many workers (0: as many as fit).")
]


class WithOptionalAddress(TyperCommand):
    """A command whose --ray may stand without a value."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:  # noqa: ANN401
        """Insert "auto" between --ray and another option, or the end."""
        words: list[str] = []
        for word, following in zip(args, [*args[1:], "-"], strict=True):
            words += [word, "auto"] if word == "--ray" and following.startswith("-") else [word]
        return super().parse_args(ctx, words)


@app.command(cls=WithOptionalAddress)
def bulk(  # noqa: PLR0913, PLR0917 one parameter per option
    root: RootArgument,
    out: Annotated[str, typer.Option(metavar="DIR", help="Folder, or URL, for the panoramas.")],
    shard: ShardOption = "0/1",
    save: SaveOption = "",
    layout: LayoutOption = "",
    use_labels: LabelsOption = False,
    topic: opt.TopicOption = "",
    every: opt.EveryOption = 1,
    start_s: opt.FromOption = None,
    end_s: opt.ToOption = None,
    weights: opt.WeightsOption = opt.BEST,
    look: opt.LookOption = "",
    quality: opt.QualityOption = "fast",
    seed: opt.SeedOption = 0,
    elevation: opt.ElevationOption = "",
    device: opt.DeviceOption = "auto",
    engine: opt.EngineOption = "auto",
    image_format: opt.FormatOption = "png",
    projection: opt.ProjectionOption = "cylinder",
    address: AddressOption = "",
    workers: WorkersOption = 0,
    sensor_height: opt.HeightOption = None,
    forward: opt.ForwardOption = "",
    remission: opt.RemissionOption = "",
    strict: opt.StrictOption = False,
    cores: Annotated[int, typer.Option(min=1, metavar="N", help="With --ray: processor cores of each worker.")] = CORES,
) -> None:
    """Translate any number of scans, without cameras. Repeat the command to go on."""
    from lidar2pano.bulk import Job, Shard
    from lidar2pano.cli.batch import checked_options
    from lidar2pano.drives.reading import Overrides, ReadingOptions, ReadOptions

    pictures = opt.collect_pictures(image_format, projection)
    _check_layout(layout, elevation, **pictures)
    source, only = _source(root)
    local_device = "cpu" if address and device in ("auto", "cuda") else device  # a cluster has its own GPUs
    options = checked_options(
        weights,
        **opt.collect_choices(local_device, engine, look, quality, seed, elevation),
        out=Path(out),
        save=opt.parse_save(save or ("rgb,segments,depth" if layout else "rgb")),
        **pictures,
    )
    job = Job(
        source=_absolute(source),
        out=_absolute(out),
        save=options.save,
        layout=layout,
        use_labels=use_labels,
        weights=options.weights,
        pipeline=options.pipeline,
        **pictures,
        reading=ReadingOptions(
            selection=ReadOptions(topic=topic, every=every, start_s=start_s, end_s=end_s),
            overrides=Overrides(sensor_height_m=sensor_height, forward=forward, remission=remission),
            strict=strict,
        ),
    )
    raise typer.Exit(run(job, Shard.parsed(shard), options, Cluster(address, device, workers, cores), only))


def run(job: Job, part: Shard, options: Options, cluster: Cluster, only: str) -> int:
    """List the scans, check existing outputs, translate the other scans, and return the exit code.

    only  name of the single recording to translate; "": all below the job's source.
    """
    from lidar2pano.bulk import Manifest, Shard, entries, start, translate_all
    from lidar2pano.bulk.stores import Folder, open_store
    from lidar2pano.drives.folders import left_out
    from lidar2pano.models.card import read_card

    if not cluster.address and (cluster.workers or cluster.cores != CORES):
        raise InputError("--workers and --cores: are those of a Ray cluster; name --ray too")
    store = open_store(job.source)
    find = partial(entries, store, layout=job.layout, labels=job.use_labels, selection=job.reading.selection, only=only)
    listed = find(part)
    if isinstance(store, Folder) and not only and (note := left_out(store.root, {entry.key.input for entry in listed})):
        print_note(note)
    painted = {"look": options.look, "quality": options.quality, "seed": options.seed}
    painted["elevation"] = options.elevation or None  # no entry in runs of before
    settings = painted | {"engine": options.engine, "format": options.image_format}
    start(job, listed, options.files, settings)
    print_weights(options.note, map(read_card, options.files.values()))
    manifest = Manifest(open_store(job.out), part)
    if not listed:
        print(f"shard {part.index}/{part.count} is empty; scans in all: {len(find(Shard()))}")
        return 0
    if cluster.address:
        return work_on_ray(job, listed, manifest, options, cluster)
    return work(job, listed, manifest, translate_all)


class Cluster(NamedTuple):
    """--ray, --device, --workers and --cores."""

    address: str
    device: str
    workers: int
    cores: int


def work_on_ray(job: Job, listed: list[Entry], manifest: Manifest, options: Options, cluster: Cluster) -> int:
    """Do `work` on a Ray cluster; its machines and not this one decide on the device."""
    import torch

    from lidar2pano.bulk.on_ray import connected, translate_on_ray

    with connected(cluster.address) as resources:
        gpus = 1 if cluster.device == "cuda" or (cluster.device == "auto" and resources.get("GPU")) else 0
        fitting = resources.get("GPU", 0) if gpus else resources.get("CPU", 0) // cluster.cores
        count = cluster.workers or max(1, int(fitting))
        translate = partial(translate_on_ray, workers=count, cores=cluster.cores, gpus=gpus)
        options = replace(options, device=torch.device("cuda" if gpus else "cpu"))
        return work(replace(job, pipeline=options.pipeline), listed, manifest, translate)


def _source(root: str) -> tuple[str, str]:
    """Return the folder or URL of the scans, and the name of the recording in it if ROOT is one."""
    from lidar2pano.bulk.listing import is_bag_folder
    from lidar2pano.bulk.stores import open_store
    from lidar2pano.recordings.recorded_scans import ENDINGS, recording_reader

    url = "://" in root and not root.startswith("file://")
    path = Path(root.removeprefix("file://"))
    if url:
        is_recording = root.lower().endswith(ENDINGS) or is_bag_folder(open_store(root))
    elif path.is_dir():
        is_recording = is_bag_folder(open_store(path))
    elif path.is_file() and recording_reader(path):
        is_recording = True
    else:
        raise InputError(f"{root}: is neither a folder nor a recording; name one, or a URL")
    if not is_recording:
        return root, ""
    folder, _, name = (root if url else str(path.absolute())).rstrip("/").rpartition("/")
    return folder or "/", name


def _check_layout(layout: str, elevation: str, image_format: str, projection: str) -> None:
    from lidar2pano.bulk.entries import LAYOUTS

    if layout not in LAYOUTS:
        raise InputError(f"--as {layout}: no such layout{closest(layout, LAYOUTS[1:])}")
    if layout and image_format != "png":
        raise InputError(f"--format {image_format}: a data set's panoramas are PNG; leave it out, or --as")
    if layout and elevation:
        raise InputError(f"--elevation {elevation}: a data set's panoramas have the usual rows; leave it out, or --as")
    if layout and projection != "cylinder":
        raise InputError(f"--projection {projection}: a data set's panoramas are cylinders; leave it out, or --as")


def _absolute(place: str) -> str:
    """Return a folder's whole path, as processes elsewhere need it; a URL as it is."""
    return place if "://" in place else str(Path(place).absolute())


def work(job: Job, listed: list[Entry], manifest: Manifest, translate: Translate) -> int:
    """Translate scans without outputs, and return the exit code."""
    from lidar2pano.bulk.manifest import remaining

    todo = remaining(job, listed, manifest)
    with until_signal(signal.SIGTERM) as terminated:
        stopped = terminated.is_set
        written, bad, doubted = consume(translate(job, todo, stopped), len(todo), manifest)
        timed = write_all_times(job, listed, manifest.shard, stopped)
    done = len(listed) - len(todo)
    left = len(todo) - written - bad
    counts = [(written, "written"), (done, "there before"), (bad, "bad"), (left, "left")]
    print(
        f"{len(listed)} scan{'s' * (len(listed) != 1)}: "
        + ", ".join(f"{count} {name}" for count, name in counts if count)
        + (f"; {doubted} of them doubted (see `doubts` in the manifest)" if doubted else "")
    )
    if terminated.is_set() and (left or not timed):
        print_error(f"stopped {f'with {left} scans left' if left else 'before times.txt'}; repeat the command to go on")
        return TERMINATED
    return BAD_SCANS if bad else 0


def write_all_times(job: Job, listed: list[Entry], shard: Shard, stopped: Callable[[], bool]) -> bool:
    """Write times.txt and poses.txt of recordings in a data set's layout; return false if stopped before the last."""
    from lidar2pano.bulk.data_set import untimed, write_times

    sequences = untimed(job, listed, shard)
    with bar(len(sequences), "reading poses") as advance:
        for recording, name in sequences:
            if stopped() or not write_times(job, recording, name, stopped):
                return False
            advance()
    return True


def consume(records: Iterable[dict[str, Any]], total: int, manifest: Manifest) -> tuple[int, int, int]:
    """Enter records into the manifest as they come; return the counts of written, bad and doubted scans.

    Doubts are printed once for each folder or recording.
    """
    from lidar2pano.bulk import ScanKey

    written, bad, doubted = 0, 0, 0
    reported = set[str]()  # recordings with bad scans: a line each
    warnings = set[tuple[str, str]]()  # folder or recording, text
    try:
        with bar(total, "translating") as advance:
            for record in records:
                manifest.add(record)
                stream = record["input"].rpartition("/")[0] if record["scan"] is None else record["input"]
                for text in record["doubts"] or ():
                    if (stream, text) not in warnings:
                        warnings.add((stream, text))
                        print_note(f"{ScanKey(record['input'], record['scan'])}: {text}")
                if record["error"]:
                    if record["scan"] is None or record["input"] not in reported:
                        print_error(record["error"])
                    if record["scan"] is not None:
                        reported.add(record["input"])
                    bad += 1
                else:
                    written += 1
                    doubted += bool(record["doubts"])
                advance()
    finally:
        manifest.flush()
    return written, bad, doubted
