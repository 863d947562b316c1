# SPDX-License-Identifier: Apache-2.0
"""Ray: parts in their own processes, here or on a cluster, each tried again when its worker dies.

Ray is imported only here, and only when it is used. It sends no usage statistics. A cluster that was started here ends
with this process, whatever ends the process.
"""

from __future__ import annotations

import os
import shutil
import socket
import tempfile
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from dpm2_core._version import __version__
from dpm2_core.errors import Dpm2Error, UsageError, one_line
from dpm2_core.evaluation.machine import processors
from dpm2_core.extras import needs
from dpm2_core.files import part_beside
from dpm2_core.fleet.part import Outcome, Part, do_part

ATTEMPTS = 3
"""Workers that may die while they work on one part."""
MEMORY = 2 * 10**9
"""Bytes that a part declares; 1.2 GB were measured for a drive with the network, the rest is a margin."""
_POLL_INTERVAL = 0.5  # s between two polls, and between two reports of a part
_CONNECT_TIMEOUT = 5.0  # s for an address to answer
_OBJECT_STORE_BYTES = 100 * 2**20  # shared memory of a cluster on this machine: parts exchange little
_MAX_FOLDER_LENGTH = (
    20  # characters of the folder for temporary files, in which Ray makes sockets with names of up to 107
)


class Status(NamedTuple):
    """Status of a part that runs or has run: attempts, frames done, total frames, and HOST:PROCESS."""

    attempts: int
    done: int = 0
    total: int = 0
    where: str = ""


Watch = Callable[[Mapping[str, Status]], None]


class Cluster:
    """The connection to Ray. A context manager: leaving it ends the parts, and the cluster if it was started here.

    In a program that is already connected to Ray, that connection is used, and is kept.
    """

    def __init__(self, address: str | None = None, workers: int | None = None) -> None:
        """Set up the connection; nothing is started yet.

        Args:
            address: of a cluster, as `ray.init` takes it; None starts one on this machine.
            workers: largest number of parts at a time; None: as many as there are processors for.
        """
        self._address, self._workers = address, workers
        self._folder: Path | None = None
        self._connected = False
        self._ray: Any = None  # the package, once it is imported
        self._board: Any = None

    def __enter__(self) -> Cluster:
        return self

    def start(self, cores: int = 1) -> None:
        """Connect to Ray, or start it; `run` does so with the first part.

        Args:
            cores: of a part, for a cluster that is started here.

        Raises:
            UsageError: Ray is not installed, does not start, or does not answer at that address.
        """
        if self._ray is not None:
            return
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        os.environ.setdefault("RAY_worker_niceness", "0")  # 15 by default: hardly any time next to other programs
        with _loopback_only(self._address is None), needs("fleet", "a fleet"):
            import ray
        self._ray = ray
        if not ray.is_initialized():
            try:
                self._connect(ray, cores)
            except Exception as error:  # Ray raises exactly this class if it does not start in time
                self.__exit__()
                where = "Ray" if self._address is None else f"--ray {self._address}"
                raise UsageError(f"{where}: {one_line(error)}") from None
        self._board = ray.remote(num_cpus=0, max_restarts=-1, max_task_retries=-1)(_ProgressBoard).remote()

    def _connect(self, ray: Any, cores: int) -> None:
        _keep_private(Path.home() / ".ray")
        quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
        self._connected = True
        if self._address is not None:
            _check_address(self._address)
            ray.init(self._address, **quiet)
            return
        temporary = tempfile.gettempdir()
        self._folder = part_beside(Path(temporary if len(temporary) < _MAX_FOLDER_LENGTH else "/tmp") / "ray")
        self._folder.mkdir(mode=0o700)
        workers = self._workers or max(processors() // cores, 1)
        ray.init(
            "local", num_cpus=workers * cores, include_dashboard=False, object_store_memory=_OBJECT_STORE_BYTES,
            _temp_dir=str(self._folder), **quiet,
        )  # fmt: skip

    def __exit__(self, *_: object) -> None:
        if self._connected:
            self._ray.shutdown()
            self._connected = False
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None
        self._ray = None

    def run(self, parts: Iterable[Part], out: Path, watch: Watch = lambda status: None) -> Iterator[Outcome]:
        """Do the parts, and yield each outcome as a part ends; if it failed, with the reason. The others continue.

        Args:
            out: the folder of all parts, absolute. watch: called twice per second with the parts that have begun.
        """
        waiting = deque(parts)
        if not waiting:
            return
        self.start(max(part.cores for part in waiting))
        ray = self._ray
        limits = self._limits(ray)
        running: dict[Any, str] = {}
        while waiting or running:
            while waiting and len(running) < (self._workers or limits["window"]):
                part = waiting.popleft()
                running[self._submit(ray, part, out, limits)] = part.name
            ended, _ = ray.wait(list(running), timeout=_POLL_INTERVAL)
            for reference in ended:
                yield _outcome(ray, running.pop(reference), reference)
            watch(self._status(ray))

    def _limits(self, ray: Any) -> dict[str, float]:
        """Resources of the largest node (a part that declares more would wait forever), and how many to submit."""
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        cpus = [node.get("CPU", 0) for node in nodes]
        if max(cpus, default=0) < 1:
            raise UsageError(f"--ray {self._address}: no node of this cluster offers a processor")
        return {"CPU": max(cpus), "memory": max(node.get("memory", 0) for node in nodes), "window": 4 * sum(cpus)}

    def _submit(self, ray: Any, part: Part, out: Path, limits: Mapping[str, float]) -> Any:
        remote = ray.remote(_attempt).options(
            num_cpus=min(part.cores, limits["CPU"]),
            memory=min(MEMORY, limits["memory"]),
            max_retries=ATTEMPTS - 1,
            name=part.name,
        )
        return remote.remote(part, out, self._board, __version__)

    def _status(self, ray: Any) -> Mapping[str, Status]:
        try:
            status: Mapping[str, Status] = ray.get(self._board.all.remote(), timeout=_POLL_INTERVAL)
        except ray.exceptions.RayError:  # it is only for display, and is restarted
            return {}
        return status


@contextmanager
def _loopback_only(enabled: bool) -> Iterator[None]:
    """Make Ray listen only on 127.0.0.1, by a variable that is set while Ray is imported: there are no other machines.

    The variable is named after systems on which that is the default; it works on Linux, too. It is read once.
    """
    name = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
    set_here = enabled and name not in os.environ
    if set_here:
        os.environ[name] = "0"
    try:
        yield
    finally:
        if set_here:
            del os.environ[name]


def _keep_private(folder: Path) -> None:
    """Make Ray's folder private: Ray writes the access token of a cluster into it, readable for everybody."""
    with suppress(OSError):  # not ours, or a home that cannot be written: Ray reports its own errors
        folder.mkdir(mode=0o700, exist_ok=True)
        folder.chmod(0o700)


def _check_address(address: str) -> None:
    """Raise ConnectionError if the address does not answer: Ray would retry for minutes."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon or not port.isdecimal():
        return  # "auto", and other names that Ray supports
    try:
        socket.create_connection((host, int(port)), _CONNECT_TIMEOUT).close()
    except (OSError, OverflowError) as error:
        raise ConnectionError(f"no answer from this address: {error}") from None


class _ProgressBoard:
    """Progress of the parts, reported by them: an actor of Ray, in its own process."""

    def __init__(self) -> None:
        self._status: dict[str, Status] = {}

    def begin(self, name: str, where: str) -> None:
        before = self._status.get(name, Status(0))
        self._status[name] = Status(before.attempts + 1, where=where)

    def report(self, name: str, done: int, total: int) -> None:
        self._status[name] = self._status.get(name, Status(1))._replace(done=done, total=total)

    def all(self) -> dict[str, Status]:
        return self._status


def _attempt(part: Part, out: Path, board: Any, version: str) -> Outcome:
    """Do a part in the worker: an exception of the work is a result; only the death of the worker is tried again."""
    board.begin.remote(part.name, f"{socket.gethostname()}:{os.getpid()}")
    last_report = 0.0

    def advance(done: int, total: int) -> None:
        nonlocal last_report
        if done == total or time.monotonic() - last_report >= _POLL_INTERVAL:
            last_report = time.monotonic()
            board.report.remote(part.name, done, total)

    try:
        if version != __version__:
            raise Dpm2Error(f"{socket.gethostname()} has dpm2 {__version__}, but the fleet was started with {version}")
        return Outcome(part.name, "done", do_part(part, out, advance))
    except Dpm2Error as error:
        return Outcome(part.name, "failed", reason=str(error))
    except Exception as error:  # a bug ends its own part, not the others
        last = traceback.extract_tb(error.__traceback__)[-1]
        reason = f"{type(error).__name__}: {error} ({Path(last.filename).name}:{last.lineno})"
        return Outcome(part.name, "failed", reason=reason)


def _outcome(ray: Any, name: str, reference: Any) -> Outcome:
    try:
        outcome: Outcome = ray.get(reference)
    except ray.exceptions.OutOfMemoryError:
        return Outcome(name, "failed", reason="its worker was killed: the machine ran out of memory")
    except ray.exceptions.RayTaskError as error:
        return Outcome(name, "failed", reason=f"the result could not be sent back: {error.cause}")
    except ray.exceptions.RayError as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        return Outcome(name, "failed", reason=f"{ATTEMPTS} workers died while processing it: {lines[0]}")
    return outcome
