# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of a training: everything a resumed run needs to continue the same curve, written atomically."""

from __future__ import annotations

import fcntl
import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import IO, Any
from zipfile import ZipFile

import torch
from torch import nn

from dpm2_core.errors import UsageError
from dpm2_core.files import atomic_write, explaining, make_folder

CHECKPOINT, LOG, WEIGHTS = "checkpoint.pt", "log.jsonl", "weights.safetensors"
"""The files that a training writes to its folder."""


@contextmanager
def folder_lock(folder: Path, shared: bool = False) -> Iterator[None]:
    """Lock a folder against other trainings until the block ends or the process is killed, if the file system has
    locks.

    `shared`: a shared lock, only to check that no training is writing, so that several may check at once.

    Raises:
        UsageError: another training has locked it.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise UsageError(f"{folder}: another training writes to this folder; choose another --out") from None
    except OSError:  # no locks, as on some network shares
        pass
    try:
        yield
    finally:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_UN)  # also for data loaders, which inherited it from this process
        os.close(handle)


def save_checkpoint(path: Path, module: nn.Module, ema: nn.Module, optimiser: torch.optim.Optimizer, step: int) -> None:
    """Write weights, averaged weights, optimizer and step. Everything random follows from seed and step.

    Raises:
        Dpm2Error: not written, e.g. on a full disk; the previous checkpoint stays.
    """
    state = {
        "module": module.state_dict(),
        "ema": ema.state_dict(),
        "optimiser": optimiser.state_dict(),
        "step": step,
    }
    buffer = BytesIO()  # for a file that cannot grow, torch raises errors of its own
    torch.save(state, buffer)
    with atomic_write(path, "wb") as file:
        file.write(buffer.getbuffer())


def load_checkpoint(path: Path, module: nn.Module, ema: nn.Module, optimiser: torch.optim.Optimizer) -> int:
    """Restore a run; returns the step it had finished.

    Raises:
        UsageError: no checkpoint, a damaged one, or one of another network or optimizer.
    """
    try:
        with path.open("rb") as file:
            is_whole = _is_whole(file)
    except OSError as error:
        raise UsageError(f"{path}: no checkpoint: {error.strerror}") from None
    if not is_whole:
        raise UsageError(f"{path}: damaged, or not a checkpoint; remove it and start again without --resume")
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)  # executes nothing
    except Exception:  # torch's message is about its own settings, such as how to execute code in the file
        raise UsageError(f"{path}: not a checkpoint of dpm2") from None
    try:
        module.load_state_dict(state["module"])
        ema.load_state_dict(state["ema"])
        optimiser.load_state_dict(state["optimiser"])
        return int(state["step"])
    except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
        first = str(error).splitlines()[-1].strip()
        raise UsageError(f"{path}: checkpoint of another network or optimizer: {first}") from None


def _is_whole(file: IO[bytes]) -> bool:
    """Whether a file is an archive, as torch writes, and its members match their checksums, which torch ignores."""
    try:
        return ZipFile(file).testzip() is None
    except Exception:  # from BadZipFile to struct.error, depending on the damage
        return False


class Log:
    """A log with one JSON object per line, and TensorBoard if its package is installed."""

    def __init__(self, folder: Path, start: int = 0) -> None:
        """Continue the log of a stopped run before step `start`; later lines are removed, as their steps are done
        again."""
        make_folder(folder)
        path = folder / LOG
        kept = _lines_before(path, start)
        with atomic_write(path) as file:
            file.writelines(kept)
        self.file = path.open("a", buffering=1)
        try:
            from torch.utils.tensorboard import SummaryWriter

            self.board: SummaryWriter | None = SummaryWriter(str(folder / "tensorboard"))
        except ImportError:
            self.board = None

    def write(self, step: int, figures: dict[str, float]) -> None:
        """Log figures of a step; one that is not finite is written as null.

        Raises:
            Dpm2Error: not written, e.g. on a full disk.
        """
        rounded = {k: round(v, 6) if math.isfinite(v) else None for k, v in figures.items()}
        with explaining(Path(self.file.name)):
            self.file.write(json.dumps({"step": step, **rounded}) + "\n")
        if self.board is not None:
            for name, value in figures.items():
                self.board.add_scalar(name, value, step)

    def close(self) -> None:
        """Flush and close."""
        self.file.close()
        if self.board is not None:
            self.board.close()


def read_log(folder: Path) -> list[dict[str, Any]]:
    """What a training has logged, one entry per line."""
    return [json.loads(line) for line in (folder / LOG).read_text(encoding="utf-8").splitlines()]


def _lines_before(path: Path, start: int) -> list[str]:
    """Lines of a log for steps before `start`; an incomplete last line is dropped."""
    if not start or not path.exists():
        return []
    kept = []
    for line in path.read_text(encoding="utf-8").splitlines():
        with suppress(ValueError, KeyError, TypeError):
            if json.loads(line)["step"] < start:
                kept.append(f"{line}\n")
    return kept
