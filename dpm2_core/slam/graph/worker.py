# SPDX-License-Identifier: Apache-2.0
"""Optimizes a pose graph in its own process: gtsam holds Python's lock while it works, and odometry must not wait.

The process is a fresh interpreter, which is safe with rclpy's threads and locks, never a fork. It has its own session,
so that an interrupt from the terminal reaches only the program. It lives as long as its standard input: when the
program ends, in whatever way, the process reads end of file and exits.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from dpm2_core.errors import Dpm2Error
from dpm2_core.slam.graph.graph_data import GraphData
from dpm2_core.slam.graph.robust import RobustSettings, Solution, optimize

_NICENESS = 10  # lower priority than the odometry, for machines with few processors


class GraphWorker:
    """A process that solves one graph at a time; started with the first graph, and again after it died."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._waiter: threading.Thread | None = None
        self._solution: Solution | Dpm2Error | None = None

    @property
    def busy(self) -> bool:
        """Whether a graph was submitted and its solution was not taken yet."""
        return self._waiter is not None

    def submit(self, graph: GraphData, settings: RobustSettings) -> None:
        """Start solving; returns at once. `busy` must be False."""
        assert self._waiter is None, "a graph is being solved"
        # The thread only waits for the pipes: the first write lasts until the process has imported gtsam.
        self._waiter = threading.Thread(target=self._exchange, args=(graph, settings), daemon=True)
        self._waiter.start()

    def take(self, wait: bool = False) -> Solution | None:
        """The solution, returned once; None while there is none.

        Raises:
            Dpm2Error: the process died, or the graph cannot be solved. The worker can be used again.
        """
        if self._waiter is None or (self._waiter.is_alive() and not wait):
            return None
        self._waiter.join()
        self._waiter, result, self._solution = None, self._solution, None
        if isinstance(result, Dpm2Error):
            raise result
        return result

    def close(self) -> None:
        """End the process."""
        while self._waiter is not None:
            if (process := self._process) is not None:
                process.kill()
            self._waiter.join(0.1)  # repeatedly: it may be about to start the process
            if not self._waiter.is_alive():
                self._waiter, self._solution = None, None
        process, self._process = self._process, None
        if process is not None:
            _end(process)

    def _exchange(self, graph: GraphData, settings: RobustSettings) -> None:
        process = self._process
        if process is None or process.poll() is not None:
            process = self._process = _start()
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            pickle.dump((graph, settings.model_dump()), process.stdin, protocol=5)
            process.stdin.flush()
            self._solution = pickle.load(process.stdout)
        except (OSError, ValueError, EOFError, pickle.UnpicklingError):
            self._process, status = None, _end(process)
            self._solution = Dpm2Error(f"the pose graph optimizer's process ended by itself (status {status})")


def _start() -> subprocess.Popen[bytes]:
    root = str(Path(__file__).resolve().parents[3])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        [sys.executable, "-m", __name__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )


def _end(process: subprocess.Popen[bytes]) -> int:
    """End the process; returns its exit status."""
    process.kill()
    status = process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):  # data that it has not read
                pipe.close()
    return status


def _serve(requests: IO[bytes], results: IO[bytes]) -> None:
    """Solve graphs until end of file."""
    while True:
        try:
            graph, settings = pickle.load(requests)
        except EOFError:
            return
        result: Any
        try:
            result = optimize(graph, RobustSettings(**settings))
        except Dpm2Error as error:
            result = error
        pickle.dump(result, results, protocol=5)
        results.flush()


if __name__ == "__main__":
    os.nice(_NICENESS)
    solutions = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of libraries must not get between the solutions
    try:
        _serve(sys.stdin.buffer, solutions)
    except BrokenPipeError:  # the program has ended
        os._exit(0)
