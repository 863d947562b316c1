# SPDX-License-Identifier: Apache-2.0
"""A graph in the solver process."""

from __future__ import annotations

import signal
import subprocess
import time
from typing import Any

import numpy as np
import pytest

from dpm2_core.errors import Dpm2Error
from dpm2_core.slam.graph.graph_data import GraphData
from dpm2_core.slam.graph.robust import RobustSettings
from dpm2_core.slam.graph.worker import GraphWorker


@pytest.mark.slow
def test_a_graph_that_cannot_be_solved_is_said_and_the_process_lives() -> None:
    """Previously, when numpy and not gtsam found the graph singular, the process ended, and only that was reported."""
    steps, chained = np.tile(np.eye(4), (5, 1, 1)), np.arange(5) > 0
    covariances = np.where(chained[:, None, None], 1e-4 * np.eye(6), 0)
    sound = GraphData(steps, chained, steps, covariances)
    singular = GraphData(steps, chained, steps, covariances, np.array([[0, 4]]), np.eye(4)[None], np.zeros((1, 6, 6)))
    worker = GraphWorker()
    try:
        worker.submit(singular, RobustSettings())
        with pytest.raises(Dpm2Error, match="pose graph: Singular matrix"):
            worker.take(wait=True)
        worker.submit(sound, RobustSettings())
        solution = worker.take(wait=True)
    finally:
        worker.close()
    assert solution is not None
    np.testing.assert_allclose(solution.poses, steps, atol=1e-9)  # already the solution, except for rounding


def test_a_worker_that_is_closed_while_its_process_starts_leaves_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Previously, it waited for the solution, and the process stayed until its pipe was closed."""
    started: list[subprocess.Popen[bytes]] = []
    popen = subprocess.Popen

    def slow(*args: Any, **options: Any) -> subprocess.Popen[bytes]:
        time.sleep(0.2)  # longer than `close` needs for its check
        started.append(popen(*args, **options))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", slow)
    worker = GraphWorker()
    worker.submit(GraphData(np.eye(4)[None], np.zeros(1, bool), np.eye(4)[None], np.zeros((1, 6, 6))), RobustSettings())
    worker.close()
    assert [process.poll() for process in started] == [-signal.SIGKILL]
    assert not worker.busy
