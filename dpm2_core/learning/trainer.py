# SPDX-License-Identifier: Apache-2.0
"""The training loop of both phases: AdamW, warm-up and cosine, clipping, EMA, checkpoints, several processes."""

from __future__ import annotations

import ctypes.util
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from pydantic import Field
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from dpm2_core.config import Settings
from dpm2_core.learning.checkpoint import Log, load_checkpoint, save_checkpoint


class OptimizerSettings(Settings):
    """Optimisation."""

    steps: int = Field(3000, gt=0)
    """Batches."""
    rate: float = Field(1e-3, gt=0)
    """Peak learning rate."""
    final_rate: float = Field(1e-5, ge=0)
    """At the end of the cosine."""
    warmup: int = Field(100, ge=0)
    """Steps of linear warm-up."""
    decay: float = Field(1e-4, ge=0)
    """Weight decay."""
    clip: float = Field(1.0, gt=0)
    """Largest norm of the gradient."""
    ema: float = Field(0.998, ge=0, lt=1)
    """Decay of the averaged weights, which are the ones that are kept."""
    seed: int = 0
    """Of weights, data and everything random."""
    compile: bool = True
    """torch.compile: slower to start, about twice as fast."""
    bf16: bool = True
    """bf16 autocast."""
    save_every: int = Field(200, gt=0)
    """Steps between checkpoints."""
    validate_every: int = Field(400, gt=0)
    """Steps between validations."""


def keep_memory() -> None:
    """Let glibc keep freed blocks: a step allocates the same gigabytes again, and page faults took half of it."""
    libc = ctypes.util.find_library("c")
    if libc is not None and hasattr(handle := ctypes.CDLL(libc), "mallopt"):
        handle.mallopt(-3, 1 << 30)  # M_MMAP_THRESHOLD
        handle.mallopt(-1, (1 << 31) - 1)  # M_TRIM_THRESHOLD


Loss = Callable[[nn.Module, Any, int], tuple[Tensor, dict[str, Tensor]]]


@contextmanager
def process_group() -> Iterator[tuple[int, int, torch.device]]:
    """Rank, world size and device of this process; joins the group when started by torchrun."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    cuda = torch.cuda.is_available()
    device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0"))) if cuda else torch.device("cpu")
    if cuda:
        torch.cuda.set_device(device)
    if world == 1:
        yield 0, 1, device
        return
    torch.distributed.init_process_group("nccl" if cuda else "gloo")
    try:
        yield torch.distributed.get_rank(), world, device
    finally:
        torch.distributed.destroy_process_group()


def learning_rate(settings: OptimizerSettings, step: int) -> float:
    """Linear warm-up, then a cosine from `rate` to `final_rate`."""
    if step < settings.warmup:
        return settings.rate * (step + 1) / settings.warmup
    done = (step - settings.warmup) / max(1, settings.steps - settings.warmup)
    return settings.final_rate + (settings.rate - settings.final_rate) * (1 + math.cos(math.pi * min(done, 1))) / 2


def parameter_groups(module: nn.Module, decay: float) -> list[dict[str, Any]]:
    """Weight decay on matrices only."""
    trained = [p for p in module.parameters() if p.requires_grad]
    return [
        {"params": [p for p in trained if p.ndim >= 2], "weight_decay": decay},
        {"params": [p for p in trained if p.ndim < 2], "weight_decay": 0.0},
    ]


@torch.no_grad()
def update_ema(ema: nn.Module, module: nn.Module, decay: float, step: int) -> None:
    """Averaged weights, with a shorter memory at the start; buffers, such as running means, as they are."""
    decay = min(decay, (1 + step) / (10 + step))
    for average, value in zip(ema.buffers(), module.buffers(), strict=True):
        average.copy_(value)
    averaged: list[Tensor] = list(ema.parameters())
    now: list[Tensor] = list(module.parameters())
    torch._foreach_mul_(averaged, decay)
    torch._foreach_add_(averaged, now, alpha=1 - decay)


def train(
    module: nn.Module,
    ema: nn.Module,
    batches: Iterator[Any],
    loss: Loss,
    settings: OptimizerSettings,
    out: Path,
    resume: bool,
    validate: Callable[[nn.Module], dict[str, float]] | None,
    start: int,
    rank: int,
    device: torch.device,
    until: int | None = None,
) -> None:
    """Run steps `start`.. of a training.

    Args:
        module: what is trained, on its device; `ema` its averaged twin.
        loss: of (module, batch, step), the mean over this process's share.
        validate: figures of a module for the log, called on the averaged weights.
        until: stop after this step, with a checkpoint; None for all of them.
    """
    keep_memory()
    optimizer = torch.optim.AdamW(parameter_groups(module, settings.decay), settings.rate)
    checkpoint = out / "checkpoint.pt"
    if resume and start:
        load_checkpoint(checkpoint, module, ema, optimizer)
    wrapped: nn.Module = module
    if torch.distributed.is_initialized():
        wrapped = DistributedDataParallel(module, find_unused_parameters=True)
    if settings.compile:
        wrapped.compile(dynamic=False)
    log = Log(out, append=resume) if rank == 0 else None
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, disable=rank != 0) as progress:
        task = progress.add_task("training", total=settings.steps, completed=start)
        end = settings.steps if until is None else min(until, settings.steps)
        for step in range(start, end):
            begin = time.perf_counter()
            batch = next(batches)
            waited = time.perf_counter() - begin
            rate = learning_rate(settings, step)
            for group in optimizer.param_groups:
                group["lr"] = rate
            torch.manual_seed(settings.seed * 1_000_003 + step)
            buffers = [value.clone() for value in module.buffers()]
            with torch.autocast(device.type, torch.bfloat16, enabled=settings.bf16):
                value, figures = loss(wrapped, batch, step)
            optimizer.zero_grad(set_to_none=True)
            value.backward()
            norm = nn.utils.clip_grad_norm_(module.parameters(), settings.clip)
            if norm.isfinite():
                optimizer.step()
                update_ema(ema, module, settings.ema, step)
            else:  # nothing of such a step stays, running means included
                for value, before in zip(module.buffers(), buffers, strict=True):
                    value.data.copy_(before)
            seconds = time.perf_counter() - begin
            described = {name: float(v) for name, v in figures.items()}
            progress.update(task, advance=1, description=f"loss {described['loss']:.3f}")
            if log is None:
                continue
            log.write(step, {**described, "norm": float(norm), "rate": rate, "seconds": seconds, "waited": waited})
            last = step + 1 == end
            if last or (step + 1) % settings.save_every == 0:
                save_checkpoint(checkpoint, module, ema, optimizer, step + 1)
            if validate is not None and (last or (step + 1) % settings.validate_every == 0):
                log.write(step, validate(ema))
    if log is not None:
        log.close()
