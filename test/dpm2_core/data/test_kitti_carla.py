# SPDX-License-Identifier: Apache-2.0
"""KITTI-CARLA from a small tree in its own layout: one pose per millisecond, points with their own times, no
intensity."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dpm2_core.data.kitti_carla import KittiCarlaSource
from dpm2_core.data.open import open_source
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError
from dpm2_core.geometry import se3

_VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("cos_angle_lidar_surface", "<f4"), ("timestamp", "<f4"),
                    ("instance", "<u4"), ("semantic", "<u4")])  # fmt: skip
_NAMES = {"<f4": "float32", "<u4": "uint32"}


def truth(seconds: float) -> np.ndarray:
    """T_world_lidar at a time, in a bend at 10 m/s."""
    return se3.exp([0, 0, 0.2 * seconds, 10 * seconds, 0, 0])


def write_sweep(path: Path, start: float, count: int = 50) -> None:
    """Write points of one wall at x = 20 m in the world, each in the LiDAR frame at its time."""
    vertices = np.zeros(count, _VERTEX)
    times = start + np.linspace(0, 0.099, count)
    world = np.c_[np.full(count, 20.0), np.linspace(-5, 5, count), np.linspace(0, 2, count)]
    seen = np.array([se3.transform(se3.inverse(truth(t)), p[None])[0] for t, p in zip(times, world, strict=True)])
    vertices["x"], vertices["y"], vertices["z"] = seen.T
    vertices["cos_angle_lidar_surface"], vertices["timestamp"] = -0.5, times
    properties = "".join(f"property {_NAMES[_VERTEX[name].str]} {name}\n" for name in _VERTEX.names or ())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}end_header\n"
    path.write_bytes(header.encode() + vertices.tobytes())


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Town01: three sweeps with images, and poses for 0.3 s."""
    folder = tmp_path / "Town01" / "generated"
    (folder / "frames").mkdir(parents=True)
    (folder / "images_rgb").mkdir()
    for n in range(3):
        write_sweep(folder / "frames" / f"frame_{n:04d}.ply", 0.1 * n)
        cv2.imwrite(str(folder / "images_rgb" / f"{n:04d}_0.png"), np.full((30, 40, 3), 10 * n, np.uint8))
    lines = [" ".join(map(str, [*truth(k / 1000)[:3].ravel(), k / 1000])) for k in range(300)]
    (folder / "full_poses_lidar.txt").write_text("# R(0,0) ... timestamp\n" + "\n".join(lines) + "\n")
    (folder / "lidar_to_cam0.txt").write_text("#R(0,0) ...\n1 0 0 -0.3 0 1 0 0 0 0 1 0.1")
    return tmp_path


def test_frames_poses_and_times(root: Path) -> None:
    """One pose per sweep, that of its first point. The cosine replaces the intensity."""
    source = open_source(root)
    assert isinstance(source, KittiCarlaSource)
    assert source.name == "Town01"
    assert source.poses is not None
    for n, frame in enumerate(source.frames()):
        np.testing.assert_allclose(source.poses[n], truth(0.1 * n), atol=1e-9)
        assert frame.index == n
        assert frame.stamp == n * 10**8
        np.testing.assert_allclose(frame.time_offset[[0, -1]], [0, 0.099], atol=1e-6)
        assert (frame.points[:, 3] == 0.5).all()
        assert (frame.images[0].pixels == 10 * n).all()


def test_the_folder_of_the_frames_is_the_town_as_well(root: Path) -> None:
    """It was read as a folder of PLY files: without poses, images and the cosines."""
    source = open_source(root / "Town01" / "generated" / "frames")
    assert isinstance(source, KittiCarlaSource)
    assert source.name == "Town01"
    assert source.poses is not None


def test_the_camera_looks_forward(root: Path) -> None:
    """A point ahead, to the left and above projects to the upper left. The horizontal field of view is 72 degrees."""
    camera = open_source(root).frames().__next__().images[0].camera
    x, y, z = se3.transform(se3.inverse(camera.T_lidar_cam), np.array([[10.3, 1.0, 0.9]]))[0]
    np.testing.assert_allclose([x, y, z], [-1, -1, 10], atol=1e-12)
    assert np.degrees(2 * np.arctan(20 / camera.K[0, 0])) == pytest.approx(72)


def test_what_is_missing_or_damaged(root: Path) -> None:
    """A truncated sweep costs only its own frame. Without poses there is no ground truth. An unknown town is named."""
    folder = root / "Town01" / "generated"
    sweep = folder / "frames" / "frame_0001.ply"
    sweep.write_bytes(sweep.read_bytes()[:-5])
    assert [frame.problem is None for frame in open_source(root / "Town01").frames()] == [True, False, True]
    (folder / "full_poses_lidar.txt").unlink()
    (folder / "lidar_to_cam0.txt").unlink()
    source = open_source(folder)
    assert source.poses is None
    assert next(source.frames()).images == ()
    with pytest.raises(UsageError, match=r"no sequence Town07.*Town01"):
        open_source(root, InputSettings(sequence="Town07"))
