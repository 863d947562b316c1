# SPDX-License-Identifier: Apache-2.0
"""Figures on the odometry of a node, counted while it runs."""

from __future__ import annotations

import threading
import time
from collections import deque

import numpy as np

from dpm2_core.estimates import OdometryResult


class Health:
    """Figures of the odometry: counts of the whole run, times of the last 200 frames, rate of the last 5 s."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._latencies: deque[float] = deque(maxlen=200)
        self._finished_at: deque[float] = deque(maxlen=50)
        self._seconds: dict[str, deque[float]] = {}
        self.processed = self.failed = 0
        self.last: OdometryResult | None = None
        self.scale = ""
        """The preset that `slam.preset` auto has chosen by the scans; else empty."""
        self._last_good: float | None = None

    def add(self, tracked: OdometryResult, latency: float) -> None:
        """Add a frame whose result was published `latency` s after its cloud arrived."""
        now = time.monotonic()
        with self._lock:
            self.processed += 1
            self.failed += tracked.failed
            self.last = tracked
            self._latencies.append(latency)
            self._finished_at.append(now)
            for stage, seconds in tracked.seconds.items():
                self._seconds.setdefault(stage, deque(maxlen=200)).append(seconds)
            if tracked.registration.ok:
                self._last_good = now

    def figures(self) -> dict[str, object]:
        """Name (with its unit) to value."""
        now = time.monotonic()
        with self._lock:
            out: dict[str, object] = {
                "state": self.last.state if self.last else "waiting",
                "processed": self.processed,
                "failed registrations": self.failed,
                "rate (Hz)": f"{self._rate(now):.1f}",
            }
            if self.scale:
                out["scale"] = self.scale
            if self.last is not None:
                out["confidence"] = f"{self.last.registration.confidence:.2f}"
                out["breaks"] = self.last.breaks
            if self._last_good is not None:
                out["last good registration (s ago)"] = f"{now - self._last_good:.1f}"
            latency, seconds = list(self._latencies), {stage: list(s) for stage, s in self._seconds.items()}
        if latency:  # from here on without the lock, for which the worker would have to wait
            p50, p95 = np.percentile(latency, [50, 95]) * 1000
            out |= {"latency p50 (ms)": f"{p50:.1f}", "latency p95 (ms)": f"{p95:.1f}"}
        return out | {f"{stage} p50 (ms)": f"{1000 * np.median(s):.1f}" for stage, s in seconds.items()}

    def _rate(self, now: float) -> float:
        recent = [done for done in self._finished_at if done > now - 5]
        return (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0
