# SPDX-License-Identifier: Apache-2.0
"""Packed training drives: from the synthetic city, one per world, and from any source with poses."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import as_completed
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, field_validator

from dpm2_core.config import Settings
from dpm2_core.console import Advance, untold
from dpm2_core.data.packed import PackedDrive, PackedWriter, Sample, packed_writer, write_packed
from dpm2_core.data.source import Source, true_poses
from dpm2_core.data.sweep_parts import whole_sweeps
from dpm2_core.descriptors import levelling
from dpm2_core.errors import UsageError
from dpm2_core.frame import Array, Frame, Image, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.deskew import deskew
from dpm2_core.geometry.scale import ROOM_SCALE, scale_of
from dpm2_core.geometry.tilt import tilt_of
from dpm2_core.network.images import in_encoded_axes, small_image
from dpm2_core.network.packed_frames import crop_of
from dpm2_core.network.pyramid import MIN_POINTS, crop
from dpm2_core.network.settings import NetworkSettings, preset
from dpm2_core.sim.camera import calibration, render
from dpm2_core.sim.lidar import Lidar
from dpm2_core.sim.sensors import drawn_sensor
from dpm2_core.sim.settings import PRESETS, CameraConfig, LidarConfig, PresetName
from dpm2_core.sim.world import World, build_world
from dpm2_core.workers import worker_pool


class GenerateSettings(Settings):
    """Synthetic training drives."""

    worlds: int = Field(100, gt=0)
    """Worlds, each a folder."""
    first_seed: int = Field(1000, ge=0)
    """Seed of the first world; the others follow. Validation takes seeds from 900000 on."""
    frames: int = Field(70, gt=1)
    """Scans of each world, at random positions on its road."""
    length: float = Field(180.0, ge=60)
    """Road of a world, m."""
    mixture: dict[PresetName, NonNegativeFloat] = Field(
        {"city": 0.3, "suburb": 0.3, "rural": 0.28, "highway": 0.06, "tunnel": 0.06}
    )
    """Share of each kind of place; the shares need not add up to 1."""
    beams: Literal[16, 32, 64, 128] = 64
    """Beams of the LiDAR."""
    height: float = Field(1.73, gt=0.5, le=10)
    """Height of the LiDAR above the ground, m; in each world it is up to 0.2 m lower or 0.3 m higher."""
    real: float = Field(0.0, ge=0, le=1)
    """Fraction of the worlds whose LiDAR has the errors of a real one, different in each world."""
    others: float = Field(0.0, ge=0, le=1)
    """Fraction of the worlds with a LiDAR other than that of `beams` and `height`: 16 to 128 beams or a rosette, on a
    robot or on a truck, sometimes tilted."""
    traffic: float = Field(1.0, ge=0, le=1000)
    """Factor on the preset's traffic; 20 fills every lane."""
    images: bool = False
    """Render an image with each scan."""
    hours: float = Field(0.0, ge=0, le=6)
    """Largest time between two images of a world, hours: its shadows move."""
    wet: float = Field(0.0, ge=0, le=1)
    """Fraction of the worlds with drops of water on the lens."""
    preset: str = "small"
    """Network preset: its crop and image size are stored."""

    @field_validator("mixture")
    @classmethod
    def _check_shares(cls, mixture: dict[PresetName, float]) -> dict[PresetName, float]:
        if not sum(mixture.values()) > 0:
            raise ValueError("want a share above 0")
        return mixture


def generate_world(folder: Path, seed: int, settings: GenerateSettings) -> None:
    """Make and pack the drive of one world; it is the same for the same seed and settings."""
    noise = np.random.default_rng([seed, 77])
    kinds = sorted(settings.mixture)
    weights = np.array([settings.mixture[kind] for kind in kinds])
    kind = kinds[noise.choice(len(kinds), p=weights / weights.sum())]
    network = preset(settings.preset)
    world = build_world("random", kind, seed, settings.length, settings.traffic)
    lidar = _lidar(world, settings, noise)
    height, sway = lidar.config.height, lidar.config.real.sway
    camera = training_camera(network)
    weather = np.random.default_rng([seed, 81])
    if weather.random() < settings.wet:
        camera = camera.model_copy(update={"wet": float(weather.uniform(0.02, 0.3)), "lens": seed})
    samples, scale = list[Sample](), ROOM_SCALE if PRESETS[kind].indoor == "rooms" else 1.0
    for _ in range(settings.frames):
        T, time = world.sample_pose(noise, height=height, sway=sway)
        scan = lidar.drive_scan(world, T @ lidar.T_level_lidar, time, noise)
        points = se3.transform(lidar.T_level_lidar, scan.points).astype(np.float32)  # as the network reads them
        images: tuple[Image, ...] = ()
        if settings.images:
            view = calibration(camera)
            hours = float(weather.uniform(-0.5, 0.5)) * settings.hours
            pixels = render(world, camera, T @ view.T_lidar_cam, time, noise, hours)
            images = (small_image(Image(pixels, view), network.image),)
        samples.append(_sample(points, T, images, network, scale))
    sensor = lidar.config.model_dump(mode="json", exclude_defaults=True)
    about: dict[str, object] = {
        "source": "synthetic city",
        "preset": kind,
        "seed": seed,
        "scale": scale,
        "sensor": sensor,
        "crop": crop_of(network.points),
        "settings": _world_settings(settings),
    }
    write_packed(folder, samples, about)


def _world_settings(settings: GenerateSettings) -> dict[str, Any]:
    """The settings that a world is made with, in addition to its seed."""
    return settings.model_dump(mode="json", exclude={"worlds", "first_seed"})


def check_same(folder: Path, requested: Mapping[str, Any]) -> None:
    """Check that an existing packed drive was made with the settings `requested`, as far as its file records them.

    Raises:
        UsageError: it was made with others; the message names the first that differs.
    """
    recorded = PackedDrive(folder).about.get("settings")
    for name, wanted in requested.items():
        if isinstance(recorded, dict) and name in recorded and recorded[name] != wanted:
            raise UsageError(
                f"{folder}: made with {name} {recorded[name]}, not {wanted}; remove it, or choose another folder"
            )


def _lidar(world: World, settings: GenerateSettings, noise: np.random.Generator) -> Lidar:
    """The LiDAR of a world; indoors it is lower than the headroom of its route."""
    columns, height = int(noise.choice([1448, 1810, 2170])), settings.height + noise.uniform(-0.2, 0.3)
    config = LidarConfig(beams=settings.beams, columns=columns, height=height)
    if PRESETS[world.preset].indoor == "rooms":  # on a small robot or in the hand
        config = config.model_copy(update={"height": noise.uniform(0.3, 1.6), "car_body": False, "min_range": 0.4})
    config = drawn_sensor(config, settings.real, settings.others, np.random.default_rng([world.seed, 79]))
    if world.road.plan is not None:
        config = config.model_copy(update={"height": min(config.height, world.road.plan.headroom - 0.1)})
    return Lidar(config)


def training_camera(network: NetworkSettings) -> CameraConfig:
    """KITTI's field of view at twice the network's image size: averaged down, it is free of aliasing."""
    height, width = network.image.size
    return CameraConfig(width=2 * width, height=2 * height, focal=720.0 * 2 * width / 1241)


def generate(out: Path, settings: GenerateSettings, workers: int, progress: Advance = untold) -> None:
    """Make all worlds, several at a time; existing ones stay, so that a killed run can be continued.

    Raises:
        UsageError: an existing world was made with other settings.
        Dpm2Error: a world could not be written, or its process was killed. No other is begun then, nor after Ctrl-C.
    """
    seeds = range(settings.first_seed, settings.first_seed + settings.worlds)
    folders = {seed: out / f"world_{seed:06d}" for seed in seeds}
    missing = [seed for seed in seeds if not folders[seed].exists()]
    for seed in sorted(set(seeds) - set(missing)):
        check_same(folders[seed], _world_settings(settings))
    done = settings.worlds - len(missing)
    progress(done, settings.worlds)
    with worker_pool(workers) as pool:
        running = [pool.submit(generate_world, folders[seed], seed, settings) for seed in missing]
        for future in as_completed(running):
            future.result()
            done += 1
            progress(done, settings.worlds)


def pack(
    source: Source,
    folder: Path,
    network: NetworkSettings,
    frames: range | None = None,
    progress: Advance = untold,
    settings: Mapping[str, Any] | None = None,
) -> int:
    """Pack the frames of a source that have a pose, one after the other; returns their number.

    Frames that are parts of a sweep are joined. Frames that cannot be read or show fewer than `MIN_POINTS` points, too
    few for any network, are left out. Points with time offsets are deskewed to the stamp with the true motion. All data
    are stored as the network reads them: scans of a tilted sensor in leveled axes, and a drive that begins in a room
    enlarged.

    `frames`: positions to pack; `progress` is called for each. `settings`: what made the poses, see `check_same`.

    Raises:
        UsageError: the source has no poses, or wrong ones, or some of its frames lack an image that others have.
    """
    poses = true_poses(source)
    if poses is None:
        raise UsageError(f"{source.name}: no ground truth poses, which the training needs")
    chosen = frames or range(len(source))
    with packed_writer(folder) as writer:
        previous: tuple[Frame, Array] | None = None  # packed once the next pose is known, for its motion
        twist, scale, first, done = np.zeros(6), 0.0, None, 0
        for position, frame in whole_sweeps(source.frames(chosen.start, chosen.stop), chosen.start):
            progress(position + 1 - chosen.start, len(chosen))
            pose, done_before = poses[position], done
            done = len(range(chosen.start, position + 1, chosen.step))  # chosen positions, also those of parts
            readable = frame.problem is None and len(frame.points) >= MIN_POINTS
            if done == done_before or not readable or not np.isfinite(pose).all():
                continue
            scale = scale or scale_of(frame.points)
            first = first or (frame.index, _camera_names(frame))
            _check_cameras(source.name, first, (frame.index, _camera_names(frame)))
            if previous is not None:
                twist = _twist(previous, (frame, pose))
                _add_if_large(writer, _packed_sample(*previous, twist, network, scale))
            previous = frame, pose
        if previous is not None:
            _add_if_large(writer, _packed_sample(*previous, twist, network, scale))
        if not len(writer):
            raise UsageError(f"{source.name}: no readable frame with a pose")
        about = {"source": source.name, "scale": scale, "crop": crop_of(network.points)}
        writer.finish({**about, "settings": dict(settings or {})})
    return len(writer)


def _add_if_large(writer: PackedWriter, sample: Sample) -> None:
    if len(sample.cloud) >= MIN_POINTS:  # within the crop
        writer.add(sample)


def _camera_names(frame: Frame) -> list[str]:
    return [image.camera.name for image in frame.images]


def _check_cameras(name: str, first: tuple[int, list[str]], second: tuple[int, list[str]]) -> None:
    """Raise UsageError if two frames, each given by number and cameras, differ in their number of images."""
    fewer, more = sorted((first, second), key=lambda seen: len(seen[1]))
    if len(fewer[1]) < len(more[1]):
        missing = ", ".join(sorted(set(more[1]) - set(fewer[1])) or more[1])
        raise UsageError(
            f"{name}: frame {fewer[0]} has no usable image of {missing}, frame {more[0]} has one; "
            "--set input.images=false packs the drive without images"
        )


def _packed_sample(frame: Frame, pose: Array, twist: Array, network: NetworkSettings, scale: float) -> Sample:
    points = frame.points
    if frame.time_offset is not None:
        points = deskew(points, frame.time_offset, twist)
    images = tuple(small_image(image, network.image) for image in frame.images)
    if (up := tilt_of(crop(points, network.points))) is not None:
        R = levelling(up)
        points, pose = points[:, :3] @ R.T, pose @ se3.make(R.T, np.zeros(3))
        images = tuple(in_encoded_axes(image, R, 1.0) for image in images)
    return _sample(points, pose, images, network, scale)


def _sample(points: Points, pose: Array, images: tuple[Image, ...], network: NetworkSettings, scale: float) -> Sample:
    """A frame as a sample, with its world enlarged by `scale`."""
    if scale == 1:
        return Sample(crop(points, network.points), pose, images)
    T = pose.copy()
    T[:3, 3] *= scale
    cloud = crop(points[:, :3] * np.float32(scale), network.points)
    return Sample(cloud, T, tuple(in_encoded_axes(image, np.eye(3, dtype=np.float32), scale) for image in images))


def _twist(first: tuple[Frame, Array], second: tuple[Frame, Array]) -> Array:
    """(6,) [rad/s, m/s] from one stamped pose to the next."""
    seconds = max(1e-3, (second[0].stamp - first[0].stamp) * 1e-9)
    return se3.way(first[1], second[1]) / seconds
