"""Channel pruning: the weights of a network in a narrower one of the same kind, from which training goes on.

Channels stay by what the layers that read them make of them on given inputs: the mean square of a channel times the
squared weights that read it. Then, one layer after the other, what the layer answered is fitted by least squares from
what the narrower network gives it (He, Zhang, Sun 2017, arXiv:1707.06168, section 3.1, with the channels chosen so),
so that a layer makes up for those before it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from lidar2pano.errors import InputError, closest
from lidar2pano.hardware import fast_arithmetic
from lidar2pano.models import build

PIXELS = 600  # of what a layer answers to each input, at random, on which it is fitted
RIDGE = 3e-3  # of the inputs' mean square, added to each
SHUFFLED = 4  # channels that a pixel shuffle by two makes one of
Inputs = Sequence[tuple[Tensor, ...]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """A convolution or linear layer, by the groups of channels that it reads and writes.

    name    of the module;  norm: of the batch norm of what it writes, "" if none.
    reads   what its input is concatenated of: names of groups, ">NAME" for a group after a pixel shuffle by two, and
            numbers of channels that are no group.
    writes  the group, "" for none;  copies: how often, one after the other.
    """

    name: str
    reads: Sequence[str | int]
    writes: str = ""
    norm: str = ""
    copies: int = 1


def _residual(name: str, group: str) -> list[Layer]:
    """Of a CircularResidual on the channels of a group."""
    inner = f"{name}.first"
    return [
        Layer(name=f"{inner}.0", reads=[group], writes=inner, norm=f"{inner}.1"),
        Layer(name=f"{name}.second.0", reads=[inner], writes=group, norm=f"{name}.second.1"),
    ]


def _block(name: str, reads: Sequence[str | int], writes: str) -> Layer:
    """Of a conv_norm_act."""
    return Layer(name=f"{name}.0", reads=reads, writes=writes, norm=f"{name}.1")


def _salsanext(network: nn.Module) -> Iterator[Layer]:
    """Of SalsaNext: contexts, encoder, decoder."""
    before: str | int = cast(nn.Conv2d, network.get_submodule("downCntx.conv1")).in_channels
    for name in ("downCntx", "downCntx2", "downCntx3"):
        yield Layer(name=f"{name}.conv1", reads=[before], writes=name)
        yield Layer(name=f"{name}.conv2", reads=[name], writes=f"{name}.1", norm=f"{name}.bn1")
        yield Layer(name=f"{name}.conv3", reads=[f"{name}.1"], writes=name, norm=f"{name}.bn2")
        before = name
    for number in range(1, 6):
        name = f"resBlock{number}"
        inner = [f"{name}.{part}" for part in range(1, 4)]
        yield Layer(name=f"{name}.conv1", reads=[before], writes=name)
        for part, read in enumerate([before, *inner[:2]]):
            yield Layer(name=f"{name}.conv{part + 2}", reads=[read], writes=inner[part], norm=f"{name}.bn{part + 1}")
        yield Layer(name=f"{name}.conv5", reads=inner, writes=name, norm=f"{name}.bn4")
        before = name
    for number in range(1, 5):
        name = f"upBlock{number}"
        inner = [f"{name}.{part}" for part in range(1, 4)]
        for part, read in enumerate([[f">{before}", f"resBlock{5 - number}"], inner[:1], inner[1:2], inner]):
            written = [*inner, name][part]
            yield Layer(name=f"{name}.conv{part + 1}", reads=read, writes=written, norm=f"{name}.bn{part + 1}")
        before = name
    yield Layer(name="logits", reads=[before])


def _titan_pano(network: nn.Module) -> Iterator[Layer]:
    """Of TITAN-pano: stem, levels, context, pyramid, heads."""
    yield _block("stem", [cast(nn.Conv2d, network.get_submodule("stem.0")).in_channels], "stem")
    before = "stem"
    for depth in range(4):
        group = f"levels.{depth}"
        yield _block(f"{group}.0", [before], group)
        yield from _residual(f"{group}.1", group) + _residual(f"{group}.2", group)
        yield Layer(name=f"laterals.{depth}", reads=[group], writes="pyramid")
        yield _block(f"smooth.{depth}", ["pyramid"], "pyramid")
        before = group
    yield Layer(name="surround.row", reads=[before], writes=before)
    yield Layer(name="surround.all", reads=[before], writes=before)
    yield _block("surround.join", [before], before)
    yield _block("fuse", ["pyramid"], "fuse")
    yield _block("head", [">fuse", "stem"], "head")
    yield Layer(name="classes", reads=["head"])
    yield Layer(name="depth", reads=["head"])


def _scene_painter(network: nn.Module) -> Iterator[Layer]:
    """Of the scene painter: encoder, trunk, decoder, texture, codes of looks."""
    inputs = cast(nn.Conv2d, network.get_submodule("stem.0")).in_channels
    texture = cast(nn.Conv2d, network.get_submodule("texture.0.0")).in_channels
    narrow = cast(nn.Conv2d, network.get_submodule("narrow.0")).out_channels
    yield _block("stem", [inputs], "fine")
    yield _block("down1.0", ["fine"], "middle")
    yield from _residual("down1.1", "middle")
    yield _block("down2", ["middle"], "coarse")
    for number in range(len(cast(nn.ModuleList, network.get_submodule("trunk")))):
        yield from _residual(f"trunk.{number}", "coarse")
    yield _block("up1", ["coarse", inputs], "up1")
    yield _block("mix1.0", ["up1", "middle", inputs], "mix1")
    yield from _residual("mix1.1", "mix1")
    yield _block("up0", ["mix1"], "up0")
    yield _block("mix0", ["up0", "fine", inputs], "mix0")
    yield _block("narrow", ["mix0"], "narrow")
    yield _block("texture.0", ["narrow", texture - narrow], "texture.0")
    yield _block("texture.1", ["texture.0"], "texture.1")
    yield Layer(name="colour", reads=["texture.1"])
    code = cast(nn.Linear, network.get_submodule("tuned.0")).in_features
    for number, group in enumerate(("coarse", "mix1", "mix0")):
        yield Layer(name=f"tuned.{number}", reads=[code], writes=group, copies=2)


LAYERS: dict[str, Callable[[nn.Module], Iterator[Layer]]] = {
    "salsanext": _salsanext,
    "titan-pano": _titan_pano,
    "scene-painter": _scene_painter,
}


def pruned(name: str, network: nn.Module, settings: Mapping[str, Any], inputs: Inputs) -> nn.Module:
    """A network of MODELS with other settings that make it narrower, and what matters most of the weights of `network`.

    network  in evaluation mode;  inputs: of some calls of it, like those that it is used for.
    Raises InputError for networks that LAYERS does not know, and settings that make no narrower network.
    """
    if name not in LAYERS:
        raise InputError(f"no layers of {name!r} are known that could be pruned{closest(name, LAYERS)}")
    layers, smaller = list(LAYERS[name](network)), build(name, **settings).eval()
    wrong = InputError(f"{name} with settings {dict(settings)} is no narrower form of the network")
    try:
        sizes, wanted = _sizes(layers, network), _sizes(layers, smaller)
    except AttributeError:
        raise wrong from None
    if any(wanted[group] > size for group, size in sizes.items()):
        raise wrong
    convs = {layer.name: layer for layer in layers if isinstance(network.get_submodule(layer.name), nn.Conv2d)}
    before = _watched(network, list(convs), inputs)
    contributions = {
        layer: _weight(network, convs[layer]).square().sum((0, 2, 3)) * record.squares()
        for layer, record in before.items()
    }
    kept = _chosen(layers, sizes, wanted, contributions)
    state = dict(network.state_dict())
    for layer in layers:
        state |= _of_layer(layer, state, sizes, kept)
    for weight in (f"{name}.weight" for name in convs):
        state[weight] = _middle(state[weight], smaller.get_parameter(weight).shape)
    try:
        smaller.load_state_dict(state)
    except RuntimeError:
        raise wrong from None
    for layer in before:  # in the order in which they are called
        record = before[layer].answers
        written = kept.get(convs[layer].writes, torch.arange(record.shape[1]))
        now = _watched(smaller, [layer], inputs, stop=True)[layer]
        _fit(cast(nn.Conv2d, smaller.get_submodule(layer)), now.patches, record[:, written])
    return smaller


def _sizes(layers: Sequence[Layer], network: nn.Module) -> dict[str, int]:
    """Channels of each group."""
    written = [layer for layer in layers if layer.writes]
    return {each.writes: len(_weight(network, each)) // each.copies for each in written}


def _weight(network: nn.Module, layer: Layer) -> Tensor:
    return cast(nn.Conv2d, network.get_submodule(layer.name)).weight.detach()


class _Stop(Exception):  # noqa: N818 no error: what is wanted is recorded
    """Ends a forward pass."""


@dataclass(slots=True)
class _Record:
    """Of a convolution, at the same pixels whenever it is watched: patches (P, D) it read, answers (P, outputs)."""

    patches: Tensor
    answers: Tensor
    taps: int

    def squares(self) -> Tensor:
        """Mean square of each channel that it reads."""
        return self.patches.square().mean(0).view(-1, self.taps).mean(1)


@torch.no_grad()
def _watched(network: nn.Module, names: Sequence[str], inputs: Inputs, stop: bool = False) -> dict[str, _Record]:
    """What convolutions read and answer on `inputs`, in the order in which they are called.

    stop  whether forward passes end there.
    """
    found: dict[str, list[tuple[Tensor, Tensor]]] = {}

    def watch(name: str) -> Callable[..., None]:
        def hook(conv: nn.Conv2d, read: tuple[Tensor, ...], answer: Tensor) -> None:
            found.setdefault(name, []).append(_sampled(conv, torch.cat(read, 1), answer, len(found.get(name, []))))
            if stop:
                raise _Stop

        return hook

    hooks = [network.get_submodule(name).register_forward_hook(watch(name)) for name in names]
    try:
        for each in inputs:
            try:
                with fast_arithmetic(each[0].device):
                    network(*each)
            except _Stop:
                pass
    finally:
        for hook in hooks:
            hook.remove()
    joined = {name: [torch.cat(parts) for parts in zip(*pairs, strict=True)] for name, pairs in found.items()}
    taps = {name: cast(nn.Conv2d, network.get_submodule(name)).weight[0, 0].numel() for name in joined}
    return {name: _Record(patches, answers, taps[name]) for name, (patches, answers) in joined.items()}


def _sampled(conv: nn.Conv2d, x: Tensor, answer: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Patches and answers of a convolution, (P, D) and (P, outputs) float32, at random pixels away from the ends."""
    stride, dilation = cast(Any, conv.stride), cast(Any, conv.dilation)
    kernel = cast(Any, conv.kernel_size)
    reach = [dilation[axis] * (kernel[axis] - 1) // 2 for axis in (0, 1)]
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randint(answer.shape[2], (PIXELS,), generator=generator)
    away = -(-reach[1] // stride[1])  # columns at the ends are closed, or padded
    columns = torch.randint(away, answer.shape[3] - away, (PIXELS,), generator=generator)
    ends = reach[1] if x.shape[3] <= answer.shape[3] * stride[1] else 0  # an image may have them already
    padded = pad(x[0].float(), (ends, ends, reach[0], reach[0]))
    taps = [
        padded[:, rows * stride[0] + i * dilation[0], columns * stride[1] + j * dilation[1]]
        for i in range(kernel[0])
        for j in range(kernel[1])
    ]
    return torch.stack(taps, 1).flatten(0, 1).T, answer[0, :, rows, columns].T.float()


def _fit(conv: nn.Conv2d, patches: Tensor, answers: Tensor) -> None:
    """Set weight and bias of a convolution so that it answers in the mean square as nearly as it can."""
    rows = torch.cat([patches, patches.new_ones(len(patches), 1)], 1)
    gram = (rows.T @ rows).double()
    gram += RIDGE * gram.diagonal().mean() * torch.eye(len(gram), dtype=gram.dtype)
    start = torch.cat([conv.weight.detach().flatten(1), cast(Tensor, conv.bias).detach()[:, None]], 1)
    left = answers - rows @ start.T  # what is missing: where little is known, weights stay as they were
    best = start + torch.linalg.solve(gram, (rows.T @ left).double()).T
    with torch.no_grad():
        conv.weight.copy_(best[:, :-1].view_as(conv.weight))
        cast(Tensor, conv.bias).copy_(best[:, -1])


def _parts(layer: Layer, sizes: Mapping[str, int]) -> Iterator[tuple[str, bool, int, int]]:
    """Of each part that a layer reads: its group or "", whether it is shuffled, first channel, number of channels."""
    start = 0
    for read in layer.reads:
        group, shuffled = ("", False) if isinstance(read, int) else (read.removeprefix(">"), read.startswith(">"))
        count = read if isinstance(read, int) else sizes[group] // (SHUFFLED if shuffled else 1)
        yield group, shuffled, start, count
        start += count


def _chosen(
    layers: Sequence[Layer], sizes: Mapping[str, int], wanted: Mapping[str, int], contributions: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """The channels of each group that stay, sorted; those of a shuffled group by four.

    sizes, wanted  channels of each group, before and after;  contributions: of each channel that a layer reads.
    """
    together = set[str]()
    importance = {group: torch.zeros(size) for group, size in sizes.items()}
    for layer in layers:
        if (contribution := contributions.get(layer.name)) is None:
            continue
        for group, shuffled, start, count in _parts(layer, sizes):
            if group:
                part = contribution[start : start + count]
                importance[group] += part.repeat_interleave(SHUFFLED) if shuffled else part
                together |= {group} if shuffled else set()
    kept = {}
    for group, values in importance.items():
        step = SHUFFLED if group in together else 1
        best = values.view(-1, step).sum(1).topk(wanted[group] // step).indices.sort().values
        kept[group] = (best[:, None] * step + torch.arange(step)).flatten()
    return kept


def _of_layer(
    layer: Layer, state: Mapping[str, Tensor], sizes: Mapping[str, int], kept: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """The tensors of a layer and its norm, of the channels that stay."""
    weight, bias = state[f"{layer.name}.weight"], state[f"{layer.name}.bias"]
    read = torch.cat(
        [start + _within(group, shuffled, count, kept) for group, shuffled, start, count in _parts(layer, sizes)]
    )
    written = torch.arange(len(weight))
    if layer.writes:
        written = torch.cat([kept[layer.writes] + sizes[layer.writes] * copy for copy in range(layer.copies)])
    tensors = {f"{layer.name}.weight": weight[written][:, read], f"{layer.name}.bias": bias[written]}
    for part in ("weight", "bias", "running_mean", "running_var") if layer.norm else ():
        tensors[f"{layer.norm}.{part}"] = state[f"{layer.norm}.{part}"][written]
    return tensors


def _middle(weight: Tensor, shape: torch.Size) -> Tensor:
    """The middle of a convolution's kernel, where the smaller network's is smaller."""
    first = [(have - want) // 2 for have, want in zip(weight.shape[2:], shape[2:], strict=True)]
    (top, left), (rows, columns) = first, shape[2:]
    return weight[:, :, top : top + rows, left : left + columns]


def _within(group: str, shuffled: bool, count: int, kept: Mapping[str, Tensor]) -> Tensor:
    """The channels that stay of a part of what a layer reads."""
    if not group:
        return torch.arange(count)
    return kept[group][::SHUFFLED] // SHUFFLED if shuffled else kept[group]
