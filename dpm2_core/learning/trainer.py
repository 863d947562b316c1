# SPDX-License-Identifier: Apache-2.0
"""The loop that all trainings share: optimizer, warm-up and cosine, clipping, EMA, checkpoints, several processes."""

from __future__ import annotations

import copy
import ctypes.util
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from dpm2_core.config import Settings
from dpm2_core.console import QUIET, progress_bar
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.files import make_folder
from dpm2_core.learning.checkpoint import CHECKPOINT, Log, folder_lock, load_checkpoint, save_checkpoint
from dpm2_core.network.encoder import to_device
from dpm2_core.network.precision import mixed_precision

M = TypeVar("M", bound=nn.Module)
_MAX_SKIPPED_STEPS = 10
"""Steps in a row without a finite gradient: none of them changes the weights, which do not recover."""


class StepSettings(Settings):
    """How a step changes the weights."""

    kind: Literal["adamw", "adam", "sgd"] = "adamw"
    """AdamW; Adam, whose decay is a part of the gradient; or stochastic gradient descent with momentum."""
    momentum: float = Field(0.9, ge=0, lt=1)
    """Momentum of sgd; for the others the first beta."""
    drop_every: int = Field(0, ge=0)
    """Steps after which the rate is multiplied by `drop`, repeatedly, instead of the cosine; 0: the cosine."""
    drop: float = Field(0.8, gt=0, le=1)
    """See `drop_every`."""
    rate: float = Field(1e-3, gt=0)
    """Peak learning rate."""
    final_rate: float = Field(1e-5, ge=0)
    """Learning rate at the end of the cosine."""
    warmup: int = Field(100, ge=0)
    """Steps of linear warm-up, at most half of all."""
    decay: float = Field(1e-4, ge=0)
    """Weight decay."""
    clip: float = Field(1.0, gt=0)
    """Largest norm of the gradient."""
    ema: float = Field(0.998, ge=0, lt=1)
    """Decay of the averaged weights, which are the ones that are saved."""
    seed: int = Field(0, ge=0)
    """Seed of weights, data and everything random."""


class OptimizerSettings(StepSettings):
    """Optimisation, counted in steps."""

    steps: int = Field(3000, gt=0)
    """Number of steps, one batch each."""
    compile: bool = True
    """torch.compile: slower to start, about twice as fast."""
    bf16: bool = True
    """bf16 autocast, if the processor supports products of bf16."""
    save_every: int = Field(200, gt=0)
    """Steps between checkpoints."""
    validate_every: int = Field(400, gt=0)
    """Steps between validations."""


def keep_memory() -> None:
    """Let glibc keep freed blocks: a step allocates the same gigabytes again, and page faults took half of its time."""
    libc = ctypes.util.find_library("c")
    if libc is not None and hasattr(handle := ctypes.CDLL(libc), "mallopt"):
        handle.mallopt(-3, 1 << 30)  # M_MMAP_THRESHOLD
        handle.mallopt(-1, (1 << 31) - 1)  # M_TRIM_THRESHOLD


@contextmanager
def process_group() -> Iterator[tuple[int, int, torch.device]]:
    """Rank, world size and device of this process. Under torchrun it joins the group, in which only the first process
    shows its progress."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    cuda = torch.cuda.is_available()
    device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0"))) if cuda else torch.device("cpu")
    if cuda:
        torch.cuda.set_device(device)
    if world == 1:
        yield 0, 1, device
        return
    torch.distributed.init_process_group("nccl" if cuda else "gloo")
    rank = torch.distributed.get_rank()
    if rank:
        QUIET.set(True)
    try:
        yield rank, world, device
    finally:
        torch.distributed.destroy_process_group()


def learning_rate(settings: OptimizerSettings, step: int) -> float:
    """Linear warm-up, then a cosine from `rate` to `final_rate`, or drops."""
    warmup = min(settings.warmup, settings.steps // 2)  # a short training must also reach its rate
    if step < warmup:
        return settings.rate * (step + 1) / warmup
    if settings.drop_every:
        return float(settings.rate * settings.drop ** (step // settings.drop_every))
    done = (step - warmup) / max(1, settings.steps - warmup)
    return settings.final_rate + (settings.rate - settings.final_rate) * (1 + math.cos(math.pi * min(done, 1))) / 2


def parameter_groups(module: nn.Module, decay: float) -> list[dict[str, Any]]:
    """Weight decay on matrices only."""
    trained = [p for p in module.parameters() if p.requires_grad]
    return [
        {"params": [p for p in trained if p.ndim >= 2], "weight_decay": decay},
        {"params": [p for p in trained if p.ndim < 2], "weight_decay": 0.0},
    ]


def make_optimizer(module: nn.Module, settings: OptimizerSettings) -> torch.optim.Optimizer:
    """The optimizer of the settings. AdamW's decay is on matrices only, that of the others on all, as is usual."""
    if settings.kind == "adamw":
        groups = parameter_groups(module, settings.decay)
        return torch.optim.AdamW(groups, settings.rate, betas=(settings.momentum, 0.999))
    trained = [p for p in module.parameters() if p.requires_grad]
    if settings.kind == "adam":
        return torch.optim.Adam(trained, settings.rate, (settings.momentum, 0.999), weight_decay=settings.decay)
    return torch.optim.SGD(trained, settings.rate, settings.momentum, weight_decay=settings.decay)


@torch.no_grad()
def update_ema(ema: nn.Module, module: nn.Module, decay: float, step: int) -> None:
    """Update the averaged weights, with a shorter memory at the start; buffers, such as running means, are copied."""
    decay = min(decay, (1 + step) / (10 + step))
    for average, value in zip(ema.buffers(), module.buffers(), strict=True):
        average.copy_(value)
    averaged: list[Tensor] = list(ema.parameters())
    current: list[Tensor] = list(module.parameters())
    torch._foreach_lerp_(averaged, current, 1 - decay)  # exact for weights that do not learn


def _divergence(skipped: int, last: int, steps: range) -> str:
    """What happened if the steps up to `last` had no finite gradient."""
    if skipped == len(steps):
        return f"none of {skipped} steps had a finite gradient: the weights did not change"
    return f"diverged: no finite gradient since step {last + 1 - skipped} of {steps.stop}"


@dataclass(frozen=True)
class Trainer(Generic[M]):
    """A training, from its batches to the averaged weights; under torchrun in several processes.

    Attributes:
        module: to be trained. Called with a batch it returns the loss, the mean over the batch, and figures for the
            log, `loss` among them.
        batches: function of (first step, rank of the process): endless arguments of the module, for each step.
        settings: optimization.
        out: folder of `checkpoint.pt` and `log.jsonl`.
        save: writes the averaged module at the end.
        validate: figures of the averaged module for the log.
    """

    module: M
    batches: Callable[[int, int], Iterator[tuple[Any, ...]]]
    settings: OptimizerSettings
    out: Path
    save: Callable[[M], None]
    validate: Callable[[M], dict[str, float]] | None = None

    def run(self, until: int | None = None) -> None:
        """Train, from the checkpoint on if there is one; `until`: stop after this step, with a checkpoint.

        Raises:
            UsageError: a checkpoint of another training, or of more steps than the settings have; or another training
                is writing in the folder.
            Dpm2Error: no step had a finite gradient, or none of the last ten; or the weights are not finite.
        """
        keep_memory()
        make_folder(self.out)
        with process_group() as (rank, world, device), nullcontext() if rank else folder_lock(self.out):
            module = self.module.to(device).train()  # frozen parts stay in evaluation mode
            ema = copy.deepcopy(module).requires_grad_(False).eval()  # validation changes no running means
            optimizer = make_optimizer(module, self.settings)
            checkpoint = self.out / CHECKPOINT
            start = load_checkpoint(checkpoint, module, ema, optimizer) if checkpoint.exists() else 0
            if start > self.settings.steps:
                raise UsageError(f"{self.out}: has {start} steps already, but optimiser.steps is {self.settings.steps}")
            steps = range(start, self.settings.steps if until is None else min(until, self.settings.steps))
            batches = self.batches(start, rank)
            wrapped = DistributedDataParallel(module, find_unused_parameters=True) if world > 1 else module
            if self.settings.compile:
                wrapped.compile(dynamic=False)
            log = Log(self.out, start) if rank == 0 else None
            skipped, in_a_row = 0, 0  # steps without a finite gradient
            with progress_bar() as progress:
                task = progress.add_task("training", total=self.settings.steps, completed=start)
                for step in steps:
                    begin = time.perf_counter()
                    batch = next(batches)
                    waited = time.perf_counter() - begin
                    figures = self._step(wrapped, ema, optimizer, to_device(batch, device), step)
                    is_skipped = not math.isfinite(figures["norm"])
                    skipped, in_a_row = skipped + is_skipped, in_a_row + 1 if is_skipped else 0
                    if in_a_row == min(_MAX_SKIPPED_STEPS, len(steps)):  # no checkpoint: --resume ends here again
                        raise Dpm2Error(_divergence(in_a_row, step, steps))
                    figures |= {"seconds": time.perf_counter() - begin, "waited": waited}
                    progress.update(task, advance=1, description=f"loss {figures['loss']:.3f}")
                    if log is not None:
                        log.write(step, figures)
                        self._validate_and_save(ema, optimizer, log, step + 1, last=step == steps[-1])
                if skipped:
                    progress.console.print(f"{skipped} of {len(steps)} steps had no finite gradient and were skipped")
            if log is not None:
                log.close()
                self.save(ema)

    def _step(
        self, wrapped: nn.Module, ema: M, optimizer: torch.optim.Optimizer, batch: tuple[Any, ...], step: int
    ) -> dict[str, float]:
        """One step of the optimizer; figures for the log."""
        module, settings = self.module, self.settings
        rate = learning_rate(settings, step)
        for group in optimizer.param_groups:
            group["lr"] = rate
        torch.manual_seed(settings.seed * 1_000_003 + step)
        buffers = [value.clone() for value in module.buffers()]
        device = next(module.parameters()).device
        with mixed_precision(device, settings.bf16):
            loss, figures = wrapped(*batch)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(module.parameters(), settings.clip)
        if norm.isfinite():
            optimizer.step()
            update_ema(ema, module, settings.ema, step)
        else:  # undo all of such a step, running means included
            for value, before in zip(module.buffers(), buffers, strict=True):
                value.data.copy_(before)
        return {name: float(value) for name, value in figures.items()} | {"norm": float(norm), "rate": rate}

    def _validate_and_save(self, ema: M, optimizer: torch.optim.Optimizer, log: Log, done: int, last: bool) -> None:
        """Validate, then save a checkpoint, if due after `done` steps: a run stopped in between repeats both."""
        if self.validate is not None and (last or done % self.settings.validate_every == 0):
            log.write(done - 1, self.validate(ema))
        if last or done % self.settings.save_every == 0:
            save_checkpoint(self.out / CHECKPOINT, self.module, ema, optimizer, done)
