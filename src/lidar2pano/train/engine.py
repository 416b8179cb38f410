"""The training loop: any task, on the CPU, one GPU, or many GPUs and nodes; the only file that knows Lightning Fabric.

Gradients of several processes are averaged by one `all_reduce` per update, after the backward pass, instead of by
DDP's hooks during it: gradient penalties, networks that are called several times or not at all before a backward
pass, and partners whose gradients are thrown away then need no special care (StyleGAN3 does the same).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from datetime import timedelta
from math import inf, isfinite
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from lidar2pano.errors import InputError
from lidar2pano.train.checkpoint import Progress, check_recipe, load_checkpoint, save_checkpoint, write_recipe
from lidar2pano.train.clock import clock, every, interrupts
from lidar2pano.train.draws import Places, loader, seed_step
from lidar2pano.train.monitor import Meter, Monitor, Screen, Silent, check_finite
from lidar2pano.train.optimisation import Average, averaged, clip, learning_rate, make_optimizer
from lidar2pano.train.placement import arithmetic, check_shares, device_kind, device_name
from lidar2pano.train.processes import average_gradients, check_launcher, largest
from lidar2pano.train.recipe import Recipe
from lidar2pano.train.release import make_card, release, trained_on
from lidar2pano.train.task import Task, build_task

try:
    from lightning.fabric import Fabric
    from lightning.fabric.strategies.ddp import DDPStrategy
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("training needs lightning: pip install 'lidar2pano[train]'") from error

NO_MORE = ("", torch.zeros(()))  # what a task yields after its last update
VALIDATION_LIMIT = timedelta(hours=2)  # for so long the other processes wait for the one that validates


def train(recipe: Recipe, root: Path, out: Path, device: str = "auto", devices: int = 1, num_nodes: int = 1) -> Path:
    """Train what `recipe` says on the data under `root`; the same command again goes on from the last checkpoint.

    out      the run's folder: recipe.json, checkpoints/, weights/, preview/, tensorboard/.
    device   "auto", "cpu" or "cuda"; devices per node and num_nodes as for Fabric, which starts the processes.
    Returns the folder of the weight files. Ctrl-C and SIGTERM save a checkpoint and raise KeyboardInterrupt; what the
    user can mend raises InputError, a loss that is not finite FloatingPointError.
    """
    training, kind = recipe.training, device_kind(device)
    check_shares(training, devices * num_nodes)
    check_launcher(devices * num_nodes)
    check_recipe(out, recipe)
    seed_step(training.seed, 0, -1)  # fresh weights: the same in every process
    task = build_task(recipe, root)
    if set(task.networks) != set(recipe.networks):
        ours, theirs = sorted(recipe.networks), sorted(task.networks)
        raise InputError(f"task {recipe.task!r} trains {', '.join(theirs)}; the recipe has {', '.join(ours)}")
    fabric = Fabric(
        accelerator=kind,
        devices=devices,
        num_nodes=num_nodes,
        strategy=_many_processes() if devices * num_nodes > 1 else "auto",
        precision=arithmetic(training, kind),
    )
    fabric.launch()
    if fabric.is_global_zero:
        write_recipe(out, recipe)
    run = Run(fabric, recipe, task, out, data=trained_on(root, recipe.data.train))
    run.resume()
    run.go_on()
    return out / "weights"


class Run:
    """A task under way: its networks on their device, optimisers, averages and how far it is."""

    def __init__(self, fabric: Fabric, recipe: Recipe, task: Task, out: Path, data: str) -> None:
        self.fabric, self.recipe, self.task, self.out, self.data = fabric, recipe, task, out, data
        self.progress = Progress()
        self.clock = clock(0.0)
        self.meter = Meter()
        self.rates: dict[str, float] = {}
        self.monitor: Monitor = Silent()
        self.networks: dict[str, nn.Module] = dict(task.networks)  # as the task made them
        self.optimizers: dict[str, torch.optim.Optimizer] = {}
        for name, network in self.networks.items():
            if recipe.training.channels_last:
                network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
            optimizer = make_optimizer(recipe.networks[name].optimizer, network)
            task.networks[name], self.optimizers[name] = fabric.setup(network.train(), optimizer)
        decay = recipe.training.ema
        self.averages = {name: Average(self.networks[name], decay) for name in task.released if decay > 0}

    def resume(self) -> None:
        """Take up the last checkpoint, if there is one."""
        found = load_checkpoint(self.out)
        step = found[0].step if found else 0
        if largest(self.fabric.device, step, -step) != [step, -step]:
            raise InputError(f"{self.out}: the nodes see different checkpoints; use a folder that all of them share")
        if found is None:
            return
        self.progress, weights, optimizers = found
        for name, network in self.networks.items():
            network.load_state_dict(_below(weights, f"network/{name}/"))
            self.optimizers[name].load_state_dict(optimizers[name])
        for name, average in self.averages.items():
            average.load(_below(weights, f"average/{name}/"))

    def go_on(self) -> None:
        """Train to the end of the budget; interrupted, save and raise KeyboardInterrupt."""
        if self._behind() >= 1 and self.progress.finished == self.progress.step:
            return
        training, fabric = self.recipe.training, self.fabric
        places = Places(len(self.task.dataset), self.progress.step, training, fabric.global_rank, fabric.world_size)
        batches = iter(loader(self.task.dataset, places, training.workers, pinned=fabric.device.type == "cuda"))
        if fabric.is_global_zero:
            self.monitor = Screen(self.out, self.recipe.name, training.steps, self.progress.step)
        self.clock = clock(self.progress.seconds)
        try:
            with interrupts() as interrupted:
                if self._loop(batches, interrupted):
                    self._checkpoint()
                    fabric.barrier()
                    raise KeyboardInterrupt(f"paused at step {self.progress.step}; repeat the command to go on")
            self._finish()
        finally:
            self.monitor.close()

    def _loop(self, batches: Iterator, interrupted: Callable[[], bool]) -> bool:
        """Steps until the budget is used (False) or somebody interrupts (True)."""
        training = self.recipe.training
        checkpoint, preview, validate = (
            every(minutes, self.progress.seconds)
            for minutes in (training.checkpoint_minutes, training.preview_minutes, training.validate_minutes)
        )
        while True:
            seconds, stop = largest(self.fabric.device, self.clock(), float(interrupted()))
            self.progress.seconds = seconds
            if self._behind() >= 1:
                return False
            if stop:
                return True
            if validate(seconds):
                self._validate()
                self._checkpoint()
            elif checkpoint(seconds):
                self._checkpoint()
            if preview(seconds):
                self._preview()
            self._step(batches)

    def _behind(self) -> float:
        """The part of the run that is done, 0 to 1 and over."""
        training, progress = self.recipe.training, self.progress
        used = progress.seconds / (60 * training.minutes) if training.minutes > 0 else 0.0
        return max(progress.step / training.steps, used)

    def _step(self, batches: Iterator) -> None:
        """One optimiser step of every network that the task updates."""
        training, step, behind = self.recipe.training, self.progress.step, self._behind()
        seed_step(training.seed, self.fabric.global_rank, step)
        for name, optimizer in self.optimizers.items():
            rate = learning_rate(self.recipe.networks[name].optimizer, step, behind)
            self.rates[f"rate/{name}"] = rate
            for group in optimizer.param_groups:
                group["lr"] = rate
        micro_batches = [self.fabric.to_device(next(batches)) for _ in range(training.accumulate)]
        losses = self._update([self.task.updates(batch) for batch in micro_batches])
        for average in self.averages.values():
            average.update(step)
        self.progress.step += 1
        self.meter.add({**losses, **self.task.logs})
        if self.monitor.wants():
            self._show()

    def _update(self, turns: list[Iterator[tuple[str, Tensor]]]) -> dict[str, Tensor]:
        """Advance the micro-batches' updates in lock-step: gradients add up over them, then the network moves."""
        losses: dict[str, Tensor] = {}
        while True:
            name = ""
            for number, turn in enumerate(turns):
                with self._without_sync():
                    who, loss = next(turn, NO_MORE)
                    if number and who != name:
                        raise RuntimeError(f"updates() yielded {name!r} for one micro-batch and {who!r} for another")
                    name = who
                    if not name:
                        continue
                    if number == 0:
                        for optimizer in self.optimizers.values():  # partners may have gradients of the last update
                            optimizer.zero_grad()
                        losses[name] = torch.zeros((), device=self.fabric.device)
                    self.fabric.backward(loss / len(turns))
                    losses[name] += loss.detach() / len(turns)
            if not name:
                return losses
            weights = [weight for weight in self.networks[name].parameters() if weight.requires_grad]
            average_gradients(weights)
            clip(weights, self.recipe.networks[name].optimizer.clip)
            self.optimizers[name].step()

    @contextmanager
    def _without_sync(self) -> Iterator[None]:
        with ExitStack() as stack:
            for network in self.task.networks.values():
                stack.enter_context(self.fabric.no_backward_sync(cast(Any, network)))
            yield

    def _show(self) -> None:
        """Read the losses since the last time and show them; one that is not finite raises FloatingPointError."""
        losses = self.meter.read()
        check_finite(losses, self.progress.step)
        self.monitor.step(self.progress.step, self._behind(), {**losses, **self.rates})

    def _averaged(self) -> AbstractContextManager[None]:
        seed_step(self.recipe.training.seed, self.fabric.global_rank, self.progress.step)
        return averaged(self.networks.values(), self.averages.values())

    def _checkpoint(self) -> None:
        """Save everything that the same command needs to go on; what is not finite is not saved."""
        if not self.fabric.is_global_zero:
            return
        self._show()
        self.progress.seconds = self.clock()
        weights: dict[str, Tensor] = {}
        for name, network in self.networks.items():
            weights |= {f"network/{name}/{key}": value for key, value in network.state_dict().items()}
        for name, average in self.averages.items():
            weights |= {f"average/{name}/{key}": value for key, value in average.state.items()}
        states = {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()}
        save_checkpoint(self.out, self.progress, weights, states)

    def _preview(self) -> None:
        if self.fabric.is_global_zero:
            with self._averaged():
                self.monitor.pictures(self.progress.step, self.task.preview())
        self.fabric.barrier()

    def _validate(self) -> None:
        """Score the (averaged) weights and release them if they are the best so far."""
        progress = self.progress
        if self.fabric.is_global_zero:
            with self._averaged():
                scores = self.task.validate()
                score = scores.get("score", inf)  # a task that knows no score has its latest weights as the best
                if progress.best is None or score >= progress.best:
                    progress.best = score if isfinite(score) else None
                    self._release(scores)
            self.monitor.scores(progress.step, scores)
        progress.validated = progress.step
        self.fabric.barrier()

    def _release(self, scores: dict[str, float], last: bool = False) -> None:
        """Write the released networks as they are now."""
        score = {name: value for name, value in scores.items() if isfinite(value)}
        score |= {"split": " + ".join(self.recipe.data.val)}
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
            release(self.out, name, self.networks[name], card, last=last)

    def _finish(self) -> None:
        """The end of the budget: score, pictures, the last weights."""
        if self.progress.validated != self.progress.step:
            self._validate()
        if self.fabric.is_global_zero:
            with self._averaged():
                self._release({}, last=True)
        self._preview()
        self.progress.finished = self.progress.step
        self._checkpoint()
        self.fabric.barrier()


def _below(weights: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in weights.items() if name.startswith(prefix)}


def _many_processes() -> DDPStrategy:
    """Processes that keep their own norm statistics (the first one's count), so that one of them may run alone."""
    parameters = inspect.signature(DistributedDataParallel).parameters
    quiet = "forward_sync_buffers" if "forward_sync_buffers" in parameters else "broadcast_buffers"  # renamed, 2.13
    settings: dict[str, Any] = {quiet: False}
    return DDPStrategy(timeout=VALIDATION_LIMIT, **settings)
