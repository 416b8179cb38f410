"""The training loop: any task, on the CPU, one GPU, or many GPUs and nodes; the only user of Lightning Fabric.

Gradients of several processes are averaged by one `all_reduce` per update, after the backward pass, instead of by
DDP's hooks during it: gradient penalties, networks called several times or not at all before a backward
pass, and networks whose gradients are discarded then need no special care (StyleGAN3 does the same).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from datetime import timedelta
from math import inf, isfinite
from pathlib import Path
from typing import Any, Literal, cast

import torch
from torch import Tensor, nn

from lidar2pano.errors import InputError, hidden
from lidar2pano.hardware import pick_device
from lidar2pano.models.card import save
from lidar2pano.train.averages import EMA, averaged
from lidar2pano.train.checkpoint import (
    Progress,
    check_recipe,
    check_weights,
    claimed,
    load_checkpoint,
    make_card,
    newest_checkpoint,
    remove_others,
    save_checkpoint,
    trained_on,
    write_recipe,
    writing,
)
from lidar2pano.train.environment import (
    Timer,
    average_gradients,
    check_compiler,
    check_launcher,
    choose_precision,
    clock,
    device_name,
    has_channels_last,
    interrupts,
    largest,
    log_precision,
    shared,
)
from lidar2pano.train.monitor import Monitor
from lidar2pano.train.recipe import Optimizer, Recipe, Training
from lidar2pano.train.sampling import BatchSampler, batches, lost_workers, seed_step, steps_over
from lidar2pano.train.task import Task, predict_all, with_starts
from lidar2pano.train.tasks import build_task

try:
    with hidden("torchmetrics"):  # only its version is wanted, and it brings transformers and SciPy: 6 s a process
        from lightning_fabric import Fabric
        from lightning_fabric.plugins.precision import MixedPrecision, Precision
        from lightning_fabric.strategies.ddp import DDPStrategy
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("training needs lightning_fabric: pip install 'lidar2pano[train]'") from error

log = logging.getLogger(__name__)
logging.getLogger("lightning_fabric").setLevel(logging.ERROR)  # its remarks are no messages for users

NO_MORE_UPDATES = ("", torch.zeros(()))  # sentinel of next()
VALIDATION_LIMIT = timedelta(hours=2)  # longest wait of the other processes for the validating one
SAVING_SHARE, PREVIEW_SHARE, VALIDATION_SHARE = 0.05, 0.05, 0.15  # of the time, at most, go into each of these
SCALER = "loss scale"  # among the optimisers' states in a checkpoint
AGREE_EVERY = 10  # steps between agreements of several processes on time and interrupts

SAVED = ({"step", "exp_avg", "exp_avg_sq"}, {"momentum_buffer"})  # of each weight: Adam's, SGD's
OPTIMIZERS = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}  # and "sgd"


class Processes(DDPStrategy):
    """Processes with networks as they are, whose gradients the loop averages: so one of them may run alone."""

    def setup_module(self, module: nn.Module) -> Any:  # noqa: ANN401, PLR6301 the strategy's own
        """Return the network without DDP's hooks: norm statistics are each process's own, and the first one's count."""
        return module


def train(recipe: Recipe, root: Path, out: Path, device: str = "auto", devices: int = 1, num_nodes: int = 1) -> Path:
    """Train by a recipe on the data under `root`; the same command again goes on from the last checkpoint.

    out      the run's folder: recipe.json, checkpoints/, weights/, preview/, tensorboard/.
    device   "auto", "cpu" or "cuda"; devices per node and num_nodes as for Fabric, the starter of the processes.
    Returns the folder of the weight files. Ctrl-C and SIGTERM save a checkpoint and raise KeyboardInterrupt; mistakes
    of the user raise InputError, a loss or weight without finite values FloatingPointError.
    """
    processes, chosen = devices * num_nodes, pick_device(device)
    training = shared(recipe.training, processes)
    check_compiler(training)
    check_launcher(processes)
    recipe = with_starts(recipe)
    check_recipe(out, recipe)
    fabric = Fabric(
        accelerator=chosen.type,
        devices=devices,
        num_nodes=num_nodes,
        strategy=Processes(timeout=VALIDATION_LIMIT) if processes > 1 else "auto",
        plugins=_precision(choose_precision(training, chosen), chosen),
    )
    fabric.launch()
    with claimed(out) if fabric.is_global_zero else nullcontext():
        return _train(fabric, recipe, training, root, out)


def _precision(name: Literal["bf16-mixed", "16-mixed", "32-true"], device: torch.device) -> Precision:
    """Fabric's plugin; float16 scales losses and omits steps whose gradients overflow."""
    return Precision() if name == "32-true" else MixedPrecision(name, device.type)


def _train(fabric: Fabric, recipe: Recipe, training: Training, root: Path, out: Path) -> Path:
    """Run `train` in one of the processes; `training` has each one's share of the batch."""
    seed_step(training.seed, 0, -1)  # fresh weights: the same in every process
    try:
        task = build_task(recipe, root)
    except InputError:
        with suppress(OSError):  # a folder that holds a run stays
            out.rmdir()
        raise
    if fabric.is_global_zero:
        write_recipe(out, recipe)
        log_precision(training, fabric.device)  # later than users' mistakes: those are one line
    predict_all(task, fabric.device, fabric.global_rank, fabric.world_size)
    fabric.barrier()
    steps = steps_over(len(task.dataset), training)
    recipe = replace(recipe, training=replace(training, steps=steps))
    run = Run(fabric, recipe, task, out, data=trained_on(root, recipe.data.train))
    run.resume()
    run.go_on()
    return out / "weights"


class Run:
    """A task in training: its networks on their device, optimisers, moving averages and progress."""

    def __init__(self, fabric: Fabric, recipe: Recipe, task: Task, out: Path, data: str) -> None:
        self.fabric, self.recipe, self.task, self.out, self.data = fabric, recipe, task, out, data
        self.progress = Progress()
        self.clock = clock(0.0)
        self.meter = Meter()
        self.rates: dict[str, float] = {}
        self.monitor: Monitor | None = None  # the first process has one
        self.networks: dict[str, nn.Module] = dict(task.networks)  # as the task made them
        self.memory: nn.Module | None = getattr(task, "memory", None)
        self.optimizers: dict[str, torch.optim.Optimizer] = {}
        for name, network in self.networks.items():
            if has_channels_last(recipe.training, fabric.device):
                network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
            optimizer = make_optimizer(recipe.networks[name].optimizer, network)
            task.networks[name], self.optimizers[name] = fabric.setup(network.train(), optimizer)
            for method in getattr(task, "methods", ()):
                cast("Any", task.networks[name]).mark_forward_method(method)
            if recipe.training.compile and name in task.released:  # a penalty differentiates a critic twice
                network.compile(dynamic=False)
                log.info("%s is compiled at its first step, which takes a minute or two", name)
        self.averages = {
            name: EMA(self.networks[name], recipe.training.ema, recipe.networks[name].start_share)
            for name in task.released
            if recipe.training.ema > 0
        }

    def resume(self) -> None:
        """Load the last checkpoint, if there is one; InputError unless it fits."""
        checkpoint = load_checkpoint(self.out)
        step = checkpoint[0].step if checkpoint else 0
        if largest(self.fabric.device, step, -step) != [step, -step]:
            raise InputError(f"{self.out}: the nodes see different checkpoints; use a folder that all of them share")
        if checkpoint is None:
            return
        self.progress, weights, optimizers = checkpoint
        try:
            for name, network in self.networks.items():
                network.load_state_dict(_below(weights, f"network/{name}/"))
                load_optimizer(self.optimizers[name], optimizers[name])
            if SCALER in optimizers:
                self.fabric.strategy.precision.load_state_dict(optimizers[SCALER])
            for name, average in self.averages.items():
                average.load(_below(weights, f"average/{name}/"))
            if self.memory:  # checkpoints of earlier versions lack it
                self.memory.load_state_dict(_below(weights, "memory/") or self.memory.state_dict())
        except (LookupError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            reason = f"{type(error).__name__}: {error}".partition("\n")[0]
            raise InputError(
                f"{self.out}/checkpoints: does not fit the recipe's networks ({reason}); remove it to start again"
            ) from None
        newest = newest_checkpoint(self.out)
        if newest and self.fabric.is_global_zero:
            remove_others(newest)  # a process that was killed left them

    def go_on(self) -> None:
        """Train to the end of the budget; an interrupt saves a checkpoint and raises KeyboardInterrupt."""
        if self._done() >= 1 and self.progress.finished == self.progress.step:
            return
        training, fabric = self.recipe.training, self.fabric
        samples, step = len(self.task.dataset), self.progress.step
        sampler = BatchSampler(samples, step, training, fabric.global_rank, fabric.world_size)
        loader = batches(self.task.dataset, sampler, training.workers, pinned=fabric.device.type == "cuda")
        if fabric.is_global_zero:
            self.monitor = Monitor(self.out, self.recipe.name, training.steps, step)
        self.clock = clock(self.progress.seconds)
        try:
            with interrupts() as interrupted, lost_workers():
                if self._loop(loader, interrupted):
                    self._checkpoint()
                    fabric.barrier()
                    raise KeyboardInterrupt(f"paused at step {self.progress.step}; repeat the command to go on")
            self._finish()
        finally:
            if self.monitor:
                self.monitor.close()

    def _loop(self, loader: Iterator, interrupted: Callable[[], bool]) -> bool:
        """Steps until the budget is used (False) or an interrupt comes (True)."""
        training, start = self.recipe.training, self.progress.seconds
        checkpoint = Timer(training.checkpoint_minutes, start, SAVING_SHARE)
        preview = Timer(training.preview_minutes, start, PREVIEW_SHARE)
        validate = Timer(training.validate_minutes, start, VALIDATION_SHARE)
        first, every = self.progress.step, AGREE_EVERY if self.fabric.world_size > 1 else 1
        now, stop = start, 0.0
        while True:
            if (self.progress.step - first) % every == 0:  # processes that agree wait for each other, and for the GPU
                now, stop = largest(self.fabric.device, self.clock(), float(interrupted()))
            self.progress.seconds = now
            if self._done() >= 1:
                return False
            if stop:
                return True
            if not self._when_due(validate, now, self._validate, self._checkpoint):
                self._when_due(checkpoint, now, self._checkpoint)
            self._when_due(preview, now, self._preview)
            self._step(loader)
            if self.monitor and self.monitor.due():
                self._show()

    def _when_due(self, timer: Timer, now: float, *actions: Callable[[], None]) -> bool:
        """Do the actions if they are due, in all processes alike."""
        if not timer.due(now):
            return False
        for action in actions:
            action()
        (ended,) = largest(self.fabric.device, self.clock())
        timer.done(now, ended)
        return True

    def _done(self) -> float:
        """Completed share of the run, 0 to 1 and over."""
        return self.progress.share(self.recipe.training)

    def _step(self, loader: Iterator) -> None:
        """Take one optimiser step of every updated network."""
        training, step, done = self.recipe.training, self.progress.step, self._done()
        seed_step(training.seed, self.fabric.global_rank, step)
        for name, optimizer in self.optimizers.items():
            rate = learning_rate(self.recipe.networks[name].optimizer, step, done)
            self.rates[f"rate/{name}"] = rate
            for group in optimizer.param_groups:
                group["lr"] = rate
        micro_batches = [self.fabric.to_device(next(loader)) for _ in range(training.accumulate)]
        losses = self._update([self.task.updates(batch) for batch in micro_batches])
        for average in self.averages.values():
            average.update(step)
        self.progress.step += 1
        self.meter.add({**losses, **self.task.logs})

    def _update(self, micro_batches: list[Iterator[tuple[str, Tensor]]]) -> dict[str, Tensor]:
        """Advance the micro-batches' updates in lock-step: gradients add up over them, then the network moves."""
        losses: dict[str, Tensor] = {}
        while True:
            name = ""
            for number, updates in enumerate(micro_batches):
                network, loss = next(updates, NO_MORE_UPDATES)
                if number and network != name:
                    raise RuntimeError(f"updates() yielded {name!r} for one micro-batch and {network!r} next")
                name = network
                if not name:
                    continue
                if number == 0:
                    for optimizer in self.optimizers.values():  # others may have gradients left
                        optimizer.zero_grad()
                    losses[name] = torch.zeros((), device=self.fabric.device)
                self.fabric.backward(loss / len(micro_batches))
                losses[name] += loss.detach() / len(micro_batches)
            if not name:
                return losses
            weights = [weight for weight in self.networks[name].parameters() if weight.requires_grad]
            if self.fabric.world_size > 1:
                average_gradients(weights)
            if norm := self.recipe.networks[name].optimizer.clip:
                self.fabric.strategy.precision.unscale_gradients(cast(Any, self.optimizers[name]).optimizer)
                torch.nn.utils.clip_grad_norm_(weights, norm)
            self.optimizers[name].step()

    def _show(self) -> None:
        """Read and show the losses since the last time; NaN or infinity raises FloatingPointError."""
        losses = self.meter.read()
        if wrong := [name for name, value in losses.items() if not isfinite(value)]:
            names, step = ", ".join(wrong), self.progress.step
            raise FloatingPointError(f"{names} is not finite near step {step}; the last checkpoint is sound")
        if self.monitor:
            self.monitor.step(self.progress.step, self._done(), {**losses, **self.rates})

    @contextmanager
    def _averaged(self) -> Iterator[None]:
        """Give networks their averaged weights for a while; NaN or infinity in them raises FloatingPointError."""
        seed_step(self.recipe.training.seed, self.fabric.global_rank, self.progress.step)
        compiled = self.recipe.training.compile  # its shapes come once: compiling for them would take longer
        eager = torch.compiler.set_stance("force_eager") if compiled else nullcontext()
        with averaged(self.networks.values(), self.averages.values()), eager:
            for name in self.task.released:
                check_weights(self.networks[name].state_dict(), self.progress.step)
            yield

    def _checkpoint(self) -> None:
        """Save everything for the same command to go on; NaN or infinity is not saved."""
        if not self.fabric.is_global_zero:
            return
        self._show()
        self.progress.seconds = self.clock()
        weights: dict[str, Tensor] = {}
        for name, network in self.networks.items():
            weights |= {f"network/{name}/{key}": value for key, value in network.state_dict().items()}
        for name, average in self.averages.items():
            weights |= {f"average/{name}/{key}": value for key, value in average.state.items()}
        if self.memory:
            weights |= {f"memory/{key}": value for key, value in self.memory.state_dict().items()}
        states = {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()}
        if scaler := self.fabric.strategy.precision.state_dict():
            states[SCALER] = scaler
        save_checkpoint(self.out, self.progress, weights, states)

    def _preview(self) -> None:
        if self.monitor:
            with self._averaged():
                self.monitor.previews(self.progress.step, self.task.preview())
        self.fabric.barrier()

    def _validate(self) -> None:
        """Score the (averaged) weights and release them if they are the best so far."""
        progress = self.progress
        progress.looks += 1
        if self.monitor:
            with self._averaged():
                scores = self.task.validate()
                score = scores.get("score", inf)  # without a score the latest weights are the best
                if progress.best is None or score >= progress.best:
                    progress.best = score if isfinite(score) else None
                    self._release(scores)
            self.monitor.scores(progress.step, scores)
        progress.validated = progress.step
        self.fabric.barrier()

    def _release(self, scores: dict[str, float], last: bool = False) -> None:
        """Write the released networks as they are now."""
        score = {name: value for name, value in scores.items() if isfinite(value)}
        score |= {"split": " + ".join(self.recipe.data.val), "looks": self.progress.looks}
        ours = {
            "recipe": self.recipe.name,
            "data": self.data,
            "steps": self.progress.step,
            "device": device_name(self.fabric.device),
            "hours": round(self.clock() / 3600, 4),
            "score": {} if last else score,
        }
        for name in self.task.released:
            card = make_card(self.recipe.networks[name], self.task.card(name), ours)
            path = self.out / "weights" / f"{name}{'.last' if last else ''}.safetensors"
            with writing(path):
                save(path, self.networks[name], card)

    def _finish(self) -> None:
        """The end of the budget: score, previews, the last weights."""
        if self.progress.validated != self.progress.step:
            self._validate()
        if self.fabric.is_global_zero:
            with self._averaged():
                self._release({}, last=True)
        self._preview()
        self.progress.finished = self.progress.step
        self._checkpoint()
        self.fabric.barrier()


class Meter:
    """Means of losses since the last reading; their sums stay on the device, and no step waits for them."""

    def __init__(self) -> None:
        self.sums: dict[str, tuple[Tensor | float, int]] = {}  # and their numbers

    def add(self, values: Mapping[str, Tensor | float]) -> None:
        """Count one step's values."""
        for name, value in values.items():
            total, count = self.sums.get(name, (0.0, 0))
            self.sums[name] = total + (value.detach() if isinstance(value, Tensor) else value), count + 1

    def read(self) -> dict[str, float]:
        """Means by name; the count starts again. A NaN among the values is a NaN here."""
        means = {name: float(total) / count for name, (total, count) in self.sums.items()}
        self.sums = {}
        return means


def _below(weights: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in weights.items() if name.startswith(prefix)}


def make_optimizer(settings: Optimizer, network: nn.Module) -> torch.optim.Optimizer:
    """The optimiser of a network's trainable weights."""
    weights = [weight for weight in network.parameters() if weight.requires_grad]
    rate, decay = settings.rate, settings.weight_decay
    if settings.algorithm == "sgd":
        return torch.optim.SGD(weights, lr=rate, momentum=settings.betas[0], weight_decay=decay)
    return OPTIMIZERS[settings.algorithm](weights, lr=rate, betas=settings.betas, weight_decay=decay)


def load_optimizer(optimizer: torch.optim.Optimizer, saved: Mapping[str, Any]) -> None:
    """Go on from the saved state of an optimiser of the same weights; ValueError when it is of others, or odd.

    Its settings stay the recipe's, not the saved ones.
    """
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    for number, values in saved["state"].items():
        if number not in range(len(weights)) or values.keys() not in SAVED:
            raise ValueError(f"the optimiser's state of weight {number!r} is odd")
        for name, value in values.items():
            shape = torch.Size() if name == "step" else weights[number].shape
            if value is not None and not (torch.is_tensor(value) and value.shape == shape and value.isfinite().all()):
                raise ValueError(f"the optimiser's {name!r} of weight {number} does not fit")
    optimizer.load_state_dict({"state": saved["state"], "param_groups": optimizer.state_dict()["param_groups"]})


def learning_rate(settings: Optimizer, step: int, progress: float) -> float:
    """The rate of step `step` (from 0), when `progress` (0 to 1) of the run is done."""
    rate, progress = settings.rate * min(1.0, (step + 1) / max(settings.warmup, 1)), min(progress, 1.0)
    match settings.schedule:
        case "cosine":
            return rate * (1 + math.cos(math.pi * progress)) / 2
        case "linear":
            return rate * min(1.0, 2 * (1 - progress))
        case "exponential":
            return rate * settings.final**progress
    return rate
