# SPDX-License-Identifier: Apache-2.0
"""Poses of other programs are compared with the ground truth at the same time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpm2_core.experiments import peers
from dpm2_core.experiments.peers import KissIcp, at_stamps, end_of
from dpm2_core.experiments.slam_part import Drive, peer
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3

from ...helpers.layouts import kitti_360


def speeding_up(seconds: Array) -> Array:
    """Poses (N, 4, 4) of a car that starts to drive, 4 m/s2."""
    return np.array([se3.make(np.eye(3), [2 * t**2, 0, 0]) for t in seconds])


class SpeedingUp:
    """Returns the true pose at the last point of each sweep, as programs do that move all points to that time."""

    at_end = True

    def __init__(self) -> None:
        self.ends = list[int]()

    def add(self, frame: Frame) -> None:
        self.ends.append(end_of(frame))

    def poses(self) -> Array:
        return speeding_up((np.array(self.ends) - self.ends[0]) / 1e9 + 0.05)


def test_poses_at_the_end_of_sweeps_are_compared_at_their_stamps(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """KITTI-360's true poses are at the middle of a sweep, those of the program at its end. Without a correction, the
    motion in half a sweep would count as an error, which differs from step to step if the car accelerates."""
    root = kitti_360(recording, tmp_path / "data", ("0007",), 12)
    truth = enumerate(speeding_up(np.arange(12) / 10))
    rows = "".join(f"{k} {' '.join(map(str, T[:3].ravel()))}\n" for k, T in truth)
    (next((root / "data_poses").iterdir()) / "poses.txt").write_text(rows)
    monkeypatch.setitem(peers.PEERS, "other", lambda *_: SpeedingUp())
    drive, out = Drive(data=root, settings=[], frames=(0, None), lengths=(0.5, 1.0)), tmp_path / "out"
    out.mkdir()
    figures = peer(out, lambda done, total: None, drive, "other")
    assert figures["t_err_percent"] < 2  # 11 at the ends; the motion between two is a screw: up to 5 mm of 0.5 m


def test_poses_lie_on_the_way_from_the_end_of_the_sweep_before() -> None:
    """Exact along a screw motion, also across a pause, and before the first pose; one pose, or a clock that stands
    still, determines no motion."""
    twist = np.array([0.0, 0.0, 0.3, 8.0, 0.2, 0.0])
    stamps = np.array([0.0, 0.1, 0.2, 1.7, 1.8])
    truth, at_end = (np.array([se3.exp(twist * t) for t in times]) for times in (stamps, stamps + 0.05))
    ns = (stamps * 1e9).astype(int)
    assert at_stamps(at_end, ns + 50_000_000, ns) == pytest.approx(truth, abs=1e-9)
    assert at_stamps(at_end[:1], ns[:1] + 50_000_000, ns[:1]) == pytest.approx(at_end[:1])
    stands = np.full(5, ns[0])
    assert at_stamps(at_end, stands + 50_000_000, stands) == pytest.approx(at_end)


def test_the_end_of_a_sweep_is_its_last_point_that_is_a_measurement() -> None:
    points = np.ones((3, 4), np.float32)
    points[2] = np.nan
    frame = Frame(10**9, points, np.array([-0.05, 0.04, 0.05], np.float32))
    assert end_of(frame) == pytest.approx(1.04e9, abs=10)  # float32
    assert end_of(Frame(10**9, points)) == 10**9
    assert end_of(Frame(10**9, points[2:], np.zeros(1, np.float32))) == 10**9


def test_kiss_icp_moves_points_to_the_last_one() -> None:
    """This is what `Peer.at_end` states: versions before 1.2 moved them to the middle."""
    pytest.importorskip("kiss_icp")
    from kiss_icp.preprocess import get_preprocessor

    preprocessor = get_preprocessor(peers.kiss_icp_config(1, deskew=True))
    points = np.tile([10.0, 0.0, 0.0], (3, 1))
    moved = preprocessor.preprocess(points, np.array([0.0, 0.5, 1.0]), se3.make(np.eye(3), [1.0, 0, 0]))
    assert moved[:, 0] == pytest.approx([9.0, 9.5, 10.0])
    assert KissIcp(1, deskew=True).at_end
    assert not KissIcp(1, deskew=False).at_end
