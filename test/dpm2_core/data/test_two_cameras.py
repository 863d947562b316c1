# SPDX-License-Identifier: Apache-2.0
"""A simulated drive with a camera that looks ahead and one that looks back, as a bag, through the whole SLAM."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dpm2_core.data.bags import BagSource
from dpm2_core.data.convert import convert
from dpm2_core.data.settings import InputSettings
from dpm2_core.frame import Array, Frame, Image
from dpm2_core.geometry import se3
from dpm2_core.sim.camera import calibration, render
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.settings import CameraConfig, LidarConfig
from dpm2_core.sim.world import build_world
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.mapping.mapper import MapSettings
from dpm2_core.slam.odometry.keyframe_selection import KeyframeSettings
from dpm2_core.slam.settings import SlamSettings

from ...helpers.drives import InMemory

FRAMES = 5
CONFIG = CameraConfig(width=208, height=64, focal=120.0)
AHEAD = calibration(CONFIG)
BACK = replace(AHEAD, T_lidar_cam=np.diag([-1.0, -1, 1, 1]) @ AHEAD.T_lidar_cam, name="rear")


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Array]:
    """The bag, whose third cloud has no rear image, and T_first_lidar (FRAMES, 4, 4)."""
    world, lidar = build_world("straight", "suburb", seed=3, length=150.0), Lidar(LidarConfig(columns=900))
    rng = np.random.default_rng(0)
    poses = [world.drive_pose(3.0 + 0.1 * n) for n in range(FRAMES)]
    frames = []
    for n, T in enumerate(poses):
        points = lidar.scan(world, T, 3.0 + 0.1 * n, rng).points
        images = [
            Image(render(world, CONFIG, T @ camera.T_lidar_cam, 3.0 + 0.1 * n, rng), camera, 0.01)
            for camera in (AHEAD, BACK)[: 1 if n == 2 else 2]
        ]
        frames.append(Frame(n * 10**8, points, images=tuple(images), index=n))
    bag = tmp_path_factory.mktemp("two") / "bag"
    convert(InMemory(frames), bag)
    return bag, se3.inverse(poses[0]) @ np.array(poses)


@pytest.mark.slow
def test_frames_with_two_images_are_described_registered_and_mapped(drive: tuple[Path, Array]) -> None:
    """With the shipped network alone. The map shows the images of the first camera, and a missing image affects nothing
    else."""
    bag, T_first_lidar = drive
    source = BagSource(bag, InputSettings(image_topic="/camera/image_raw", second_image_topic="/camera_2/image_raw"))
    frames = list(source.frames())
    assert [len(frame.images) for frame in frames] == [2, 2, 1, 2, 2]
    np.testing.assert_allclose(frames[0].images[1].camera.T_lidar_cam, BACK.T_lidar_cam, atol=1e-9)
    settings = SlamSettings(
        registration="neural", keyframes=KeyframeSettings(distance=1.0), map=MapSettings(thumbnail=64)
    )
    slam = make_slam(settings)
    results = [slam.process(frame).odometry for frame in frames]
    assert all(result.registration.ok for result in results)
    for result, T in zip(results, T_first_lidar, strict=True):
        assert np.linalg.norm(result.T_odom_lidar[:3, 3] - T[:3, 3]) < 0.15
    keyframes = [(frame, result.keyframe) for frame, result in zip(frames, results, strict=True) if result.keyframe]
    assert len(keyframes) >= 3
    alone = make_slam(settings).process(replace(frames[0], images=frames[0].images[:1])).odometry.keyframe
    described = keyframes[0][1].descriptors
    assert not np.array_equal(described.features, alone.descriptors.features)
    # Corners of both images are among its descriptors: those of the rear image are behind.
    of_both = ~(described.xyz[:, None] == alone.descriptors.xyz).all(2).any(1)
    assert (described.xyz[of_both, 0] < 0).any()
    for frame, keyframe in keyframes:
        assert keyframe.thumbnail is not None
        shown = cv2.imdecode(np.frombuffer(keyframe.thumbnail, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
        small = [cv2.resize(image.pixels, shown.shape[1::-1], interpolation=cv2.INTER_AREA) for image in frame.images]
        apart = [np.abs(shown.astype(float) - image).mean() for image in small]
        assert apart[0] < 12
        assert apart[0] == min(apart)
