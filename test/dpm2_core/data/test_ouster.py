# SPDX-License-Identifier: Apache-2.0
"""Recordings of an Ouster: a sphere around the sensor, written to packets and files by Ouster's own package, and
read."""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dpm2_core.data.open import open_source
from dpm2_core.data.ouster import OusterSource
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError
from dpm2_core.extras import MissingPackageError

START, PERIOD = 1_700_000_000_000_000_000, 100_000_000  # ns
COLUMNS, SWEEPS = 512, 3
LOST = 16  # columns of the second sweep, its first packet
PORT, IMU_PORT = 7502, 7503  # UDP


def sensor(number: int = 7) -> Any:
    """Metadata of a sensor."""
    core = pytest.importorskip("ouster.sdk.core", reason="no ouster-sdk: make setup")
    lidar = core.SensorInfo.from_default(core.LidarMode(COLUMNS, 10))
    lidar.sn, lidar.config.udp_port_lidar, lidar.config.udp_port_imu = number, PORT, IMU_PORT
    lidar.format.udp_profile_lidar = lidar.config.udp_profile_lidar = core.UDPProfileLidar.RNG19_RFL8_SIG16_NIR16
    return lidar


def sweeps(info: Any) -> list[Any]:
    """Sweeps of 10, 11 and 12 m. The uppermost beam has no returns. Reflectivity 51 is an intensity of 0.2."""
    from ouster.sdk import core

    made = []
    for n in range(SWEEPS):
        sweep = core.LidarFrame(info)
        sweep.field("RANGE")[:] = 10_000 + 1000 * n
        sweep.field("RANGE")[0] = 0
        sweep.field("REFLECTIVITY")[:] = 51
        sweep.timestamp[:] = START + n * PERIOD + np.arange(COLUMNS) * PERIOD // COLUMNS
        sweep.status[:] = 1
        sweep.measurement_id[:] = np.arange(COLUMNS)
        sweep.frame_id = n + 1
        if n == 1:
            sweep.status[:LOST] = 0
        made.append(sweep)
    return made


@pytest.fixture
def osf(tmp_path: Path) -> Path:
    info = sensor()
    from ouster.sdk.osf import Writer

    path = tmp_path / "drive.osf"
    with Writer(str(path), info) as writer:
        for sweep in sweeps(info):
            writer.save(0, sweep)
    return path


@pytest.fixture
def pcap(tmp_path: Path) -> Path:
    """UDP packets as tcpdump writes them, with the metadata next to them."""
    info = sensor()
    from ouster.sdk import core

    path = tmp_path / "drive.pcap"
    blocks = [struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)]
    for n, sweep in enumerate(sweeps(info)):
        packets = core.frame_to_packets(sweep, core.PacketFormat(info), info.init_id, info.sn)
        blocks += [packet_of(PORT, bytes(packet.buf), n) for packet in packets]
        for stamp in range(START + n * PERIOD, START + (n + 1) * PERIOD, PERIOD // 10):
            # Times of the system, accelerometer and gyroscope; in g and degrees per second.
            sample = struct.pack("<QQQ6f", stamp, stamp, stamp, 0, 0, 1, 0, 0, np.degrees(0.5))
            blocks.append(packet_of(IMU_PORT, sample, n))
    path.write_bytes(b"".join(blocks))
    path.with_suffix(".json").write_text(info.to_json_string())
    return path


def packet_of(port: int, data: bytes, sweep: int) -> bytes:
    """A UDP packet as in a .pcap file, with its arrival time."""
    udp = struct.pack(">HHHH", port, port, 8 + len(data), 0)
    ip = struct.pack(">BBHHHBBH", 0x45, 0, 28 + len(data), 0, 0x4000, 64, 17, 0) + b"\1" * 4 + b"\2" * 4
    frame = b"\0" * 12 + b"\x08\x00" + ip + udp + data
    return struct.pack("<IIII", START // 10**9, sweep * PERIOD // 1000, len(frame), len(frame)) + frame


@pytest.mark.parametrize("kind", ["osf", "pcap"])
def test_points_times_and_intensities(kind: str, request: pytest.FixtureRequest) -> None:
    path: Path = request.getfixturevalue(kind)
    before = path.read_bytes()
    source = open_source(path)
    assert isinstance(source, OusterSource)
    frames = list(source.frames())
    assert (len(source), source.name, source.notes, path.read_bytes()) == (SWEEPS, "drive", [], before)
    for n, frame in enumerate(frames):
        lost = LOST if n == 1 else 0
        assert frame.problem is None
        assert frame.points.shape == (63 * (COLUMNS - lost), 4)
        ranges = np.linalg.norm(frame.points[:, :3], axis=1)
        np.testing.assert_allclose(ranges, 10 + n, atol=0.05)  # beams begin 16 to 38 mm from the sensor's axes
        np.testing.assert_allclose(frame.points[:, 3], 0.2, atol=1e-6)
        first = lost * PERIOD // COLUMNS
        assert frame.stamp == START + n * PERIOD + first
        span = (COLUMNS - 1) * PERIOD // COLUMNS - first
        np.testing.assert_allclose([frame.time_offset.min(), frame.time_offset.max()], [0, span * 1e-9], atol=1e-6)
        # One clockwise rotation: each azimuth is that of the sensor at that time.
        turned = np.unwrap(np.arctan2(*frame.points[: COLUMNS - lost, 1::-1].T.astype(float)))
        slope = np.polyfit(frame.time_offset[: COLUMNS - lost], turned, 1)[0]
        np.testing.assert_allclose(slope, -2 * np.pi * 1e9 / PERIOD, rtol=0.01)


@pytest.mark.parametrize("kind", ["osf", "pcap"])
def test_a_part_is_those_sweeps(kind: str, request: pytest.FixtureRequest) -> None:
    source = open_source(request.getfixturevalue(kind))
    assert [(frame.index, frame.stamp) for frame in source.frames(2)] == [(2, START + 2 * PERIOD)]
    assert [frame.index for frame in source.frames(0, 1)] == [0]


def test_the_samples_of_the_imu_come_with_their_sweeps(pcap: Path) -> None:
    for frame in open_source(pcap).frames():
        lost = LOST * PERIOD // COLUMNS if frame.index == 1 else 0
        begin = START + frame.index * PERIOD
        assert begin <= frame.imu.stamps[0] <= begin + PERIOD // 10
        assert begin + lost <= frame.imu.stamps[-1] <= begin + PERIOD
        np.testing.assert_allclose(frame.imu.rates, [[0, 0, 0.5]] * len(frame.imu), atol=1e-6)
        np.testing.assert_allclose(frame.imu.forces, [[0, 0, 9.80665]] * len(frame.imu), atol=1e-5)
    assert all(frame.imu is None for frame in open_source(pcap, InputSettings(imu=False)).frames())


def test_of_several_sensors_one_is_named(tmp_path: Path) -> None:
    first, second = sensor(7), sensor(8)
    from ouster.sdk.osf import Writer

    path = tmp_path / "two.osf"
    with Writer(str(path), [first, second]) as writer:
        for sweep in sweeps(first):
            writer.save(0, sweep)
        writer.save(1, sweeps(second)[2])
    with pytest.raises(UsageError, match=r"two.osf: input.points_topic is empty, want one of its sensors: 7, 8"):
        open_source(path)
    with pytest.raises(UsageError, match=r"input.points_topic=9, want one of"):
        open_source(path, InputSettings(points_topic="9"))
    source = open_source(path, InputSettings(points_topic="8"))
    (frame,) = source.frames()
    assert np.linalg.norm(frame.points[:, :3], axis=1).mean() == pytest.approx(12, abs=0.05)


def test_what_cannot_be_read_says_why(pcap: Path, osf: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pcap.with_suffix(".json").rename(pcap.with_suffix(".txt"))
    with pytest.raises(UsageError, match=r"drive.pcap: cannot be read as a recording of an Ouster: .*metadata"):
        open_source(pcap)
    cut = osf.with_name("cut.osf")
    cut.write_bytes(osf.read_bytes()[:300])
    with pytest.raises(UsageError, match=r"cut.osf: cannot be read as a recording of an Ouster: "):
        open_source(cut)
    monkeypatch.setitem(sys.modules, "ouster.sdk", None)
    with pytest.raises(MissingPackageError, match=r"drive.osf needs the package ouster.*pip install --no-deps"):
        open_source(osf)


def test_damaged_sweeps_end_the_drive_with_a_problem(osf: Path) -> None:
    data = bytearray(osf.read_bytes())
    data[len(data) // 3 : len(data) // 3 + 4] = b"\xff\0\xff\0"
    osf.write_bytes(data)
    source = open_source(osf)
    frames = list(source.frames())
    assert (len(source), len(frames)) == (SWEEPS, 1)
    assert frames[0].problem == f"{osf}: sweep 0: its data are not there"
    assert source.notes == [frames[0].problem]
