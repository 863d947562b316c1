# SPDX-License-Identifier: Apache-2.0
"""Augmentation of one sample: occlusion, drops, rigid motion with its pose and extrinsics, and the images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.data.packed import Sample
from dpm2_core.frame import Array, Image
from dpm2_core.geometry import se3
from dpm2_core.network.pyramid import MIN_POINTS

Cloud = NDArray[np.float32]


class AugmentSettings(Settings):
    """Strength of each augmentation; probabilities are per frame."""

    drop: float = Field(0.5, ge=0, lt=1)
    """Points are dropped at a ratio drawn from 0 to this."""
    occlusion: float = Field(0.1, ge=0, le=1)
    """Probability of RandomOcclusion: sectors behind near shields are removed."""
    beams: float = Field(0.1, ge=0, le=1)
    """Probability that only every second or fourth elevation is kept."""
    jitter: float = Field(0.005, ge=0)
    """Standard deviation of point noise, m, cut at 3 deviations."""
    yaw: float = Field(3.1416, ge=0)
    """Largest rotation of the sensor about its own axis, rad, to either side."""
    tilt: float = Field(0.03, ge=0)
    """Standard deviation of roll and pitch, rad."""
    shift: tuple[float, float, float] = (0.0, 0.0, 0.2)
    """Standard deviation of the origin's translation, m. Horizontal shifts move the origin away from the sensor: they
    are only for networks that work in the sensor's axes (3, 3, 1.5 there)."""
    image_drop: float = Field(0.15, ge=0, le=1)
    """Probability that all images of a frame are missing."""
    image_black: float = Field(0.05, ge=0, le=1)
    """Probability that an image is black."""
    exposure: float = Field(0.3, ge=0)
    """Standard deviation of the logarithm of exposure."""
    colour: float = Field(0.08, ge=0)
    """Standard deviation of the logarithm of each color's gain."""
    extrinsic_rotation: float = Field(0.002, ge=0)
    """Standard deviation of the rotation error of the extrinsics, rad."""
    extrinsic_translation: float = Field(0.01, ge=0)
    """Standard deviation of the translation error of the extrinsics, m."""


UNCHANGED = AugmentSettings(
    drop=0, occlusion=0, beams=0, jitter=0, yaw=0, tilt=0, shift=(0, 0, 0), image_drop=0, image_black=0, exposure=0,
    colour=0, extrinsic_rotation=0, extrinsic_translation=0,
)  # fmt: skip
"""Samples as they were packed, except for the order of their points."""


def augment(sample: Sample, settings: AugmentSettings, noise: np.random.Generator) -> Sample:
    """An augmented copy; its pose and extrinsics fit the changed cloud."""
    cloud = sample.cloud
    for change in (_thin_beams, _occlude, _drop_points):
        changed = change(cloud, settings, noise)
        if len(changed) >= 4 * MIN_POINTS:  # never lose the scan altogether
            cloud = changed
    cloud = noise.permutation(cloud)  # so that farthest point sampling starts elsewhere
    T_new_old = random_motion(settings, noise)
    jitter = np.clip(noise.standard_normal(cloud.shape, np.float32), -3, 3) * np.float32(settings.jitter)
    cloud = se3.transform(T_new_old, cloud) + jitter
    images = () if noise.random() < settings.image_drop else sample.images
    return Sample(
        cloud.astype(np.float32),
        sample.pose @ se3.inverse(T_new_old),
        tuple(augment_image(image, T_new_old, settings, noise) for image in images),
    )


def random_motion(settings: AugmentSettings, noise: np.random.Generator) -> Array:
    """T_new_old of the sensor frame."""
    yaw = noise.uniform(-settings.yaw, settings.yaw)
    tilt = noise.normal(0, 1, 2) * settings.tilt
    T_new_old = se3.exp([0, 0, yaw, 0, 0, 0]) @ se3.exp([*tilt, 0, 0, 0, 0])
    T_new_old[:3, 3] = noise.normal(0, 1, 3) * settings.shift
    return T_new_old


def _drop_points(cloud: Cloud, settings: AugmentSettings, noise: np.random.Generator) -> Cloud:
    return cloud[noise.random(len(cloud)) >= noise.uniform(0, settings.drop)]


def _thin_beams(cloud: Cloud, settings: AugmentSettings, noise: np.random.Generator) -> Cloud:
    if noise.random() >= settings.beams:
        return cloud
    elevation = np.arctan2(cloud[:, 2], np.hypot(cloud[:, 0], cloud[:, 1]))
    beam = np.round(elevation / np.radians(0.42)).astype(int)  # spacing of a 64-beam sensor
    return cloud[beam % noise.choice([2, 4]) == 0]


def _occlude(cloud: Cloud, settings: AugmentSettings, noise: np.random.Generator) -> Cloud:
    if noise.random() >= settings.occlusion:
        return cloud
    azimuth = np.arctan2(cloud[:, 1], cloud[:, 0])
    distance = np.linalg.norm(cloud, axis=1)
    is_hidden = np.zeros(len(cloud), bool)
    for shield in range(noise.integers(1, 4)):
        width = np.radians(noise.uniform(10, 150)) / (shield + 1)
        start = noise.uniform(-np.pi, np.pi)
        is_hidden |= ((azimuth - start) % (2 * np.pi) < width) & (distance >= noise.uniform(2, 10))
    return cloud[~is_hidden]


def augment_image(image: Image, T_new_old: Array, settings: AugmentSettings, noise: np.random.Generator) -> Image:
    """Exposure, color and black-out of the pixels; extrinsics moved with the LiDAR frame and slightly wrong."""
    gain = np.exp(noise.normal(0, settings.exposure) + noise.normal(0, settings.colour, 3))
    if noise.random() < settings.image_black:
        gain = np.zeros(3)
    pixels = np.clip(image.pixels * gain.astype(np.float32), 0, 255).astype(np.uint8)
    error = se3.exp(
        np.concatenate([
            noise.normal(0, settings.extrinsic_rotation, 3), noise.normal(0, settings.extrinsic_translation, 3)
        ])
    )  # fmt: skip
    camera = replace(image.camera, T_lidar_cam=T_new_old @ image.camera.T_lidar_cam @ error)
    return Image(pixels, camera)
