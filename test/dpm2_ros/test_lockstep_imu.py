# SPDX-License-Identifier: Apache-2.0
"""In lockstep, each cloud has the same IMU samples and the same fix as in `dpm2 run`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from dpm2_core.data import bag_messages, naming
from dpm2_core.data.bag_file import open_bag
from dpm2_core.data.bags import BagSource
from dpm2_core.data.messages import cloud_fields, decode_points, point_columns
from dpm2_core.data.settings import InputSettings
from dpm2_core.frame import Fix
from test.helpers.lockstep import Listener, contents, play
from test.helpers.recordings import write_bag

MS = 1_000_000


def recorded(bag: Path, folder: Path) -> Path:
    """The drive as sweeps of 0.1 s that are recorded at their stamps, with an IMU at 200 Hz, and with fixes that are
    recorded up to 0.45 s after their stamps."""
    types, rng = get_typestore(Stores.ROS2_JAZZY), np.random.default_rng(0)
    source, stamps = open_bag(bag), BagSource(bag).stamps.tolist()
    first, last = stamps[0], stamps[-1]
    link = dict.fromkeys((naming.IMU_LINK, naming.GNSS_LINK), (naming.KITTI.lidar, np.eye(4)))
    out: list[tuple[int, str, Any]] = [(first - 1000 * MS, naming.TF_STATIC, bag_messages.transforms(first, link))]
    for topic, time, data in source.messages([naming.TF_STATIC, naming.POINTS]):
        message = types.deserialize_cdr(bytes(data), source.types[topic])
        if topic == naming.POINTS:
            columns = point_columns(decode_points(message)[0])
            columns["time"] = np.linspace(0, 0.1, len(columns["x"]), dtype=np.float32)
            message = replace(message, **cloud_fields(columns, type(message.fields[0])))
        out.append((time, topic, message))
    for stamp in range(first - 100 * MS, last + 500 * MS, 5 * MS):
        out.append((stamp, naming.IMU, bag_messages.imu(stamp, rng.normal(0, 0.1, 3), np.array([0, 0, 9.8]))))
    for stamp in range(first, last, 70 * MS):
        fix = Fix(stamp, np.array([49.0, 8.4, 100.0]), np.eye(3), np.zeros(3))
        out.append((stamp + int(rng.integers(1, 450)) * MS, naming.FIX, bag_messages.nav_sat_fix(stamp, fix)))
    kinds = {topic: message.__msgtype__ for _, topic, message in out}
    return write_bag(folder, kinds, [(t, topic, types.serialize_cdr(m, kinds[topic])) for t, topic, m in out])


def test_the_samples_of_a_sweep_and_a_late_fix_are_those_of_dpm2_run(
    ros: Callable[..., Any], bag: Path, tmp_path: Path
) -> None:
    """The last samples of a sweep are recorded after its stamp; a fix that is recorded directly after a cloud is
    associated with the next cloud."""
    recording = recorded(bag, tmp_path / "recorded")
    expected = list(BagSource(recording, InputSettings(gnss_topic=naming.FIX)).frames())
    assert all(frame.imu is not None and frame.imu.stamps[-1] == frame.stamp + 100 * MS for frame in expected)
    assert sum(frame.fix is not None for frame in expected) > len(expected) / 2
    node = ros().add(Listener(gnss=naming.FIX, busy=0.05))
    play(recording)
    assert [contents(frame) for frame in node.frames] == [contents(frame) for frame in expected]
