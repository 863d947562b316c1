# SPDX-License-Identifier: Apache-2.0
"""All clouds of a map as one."""

from __future__ import annotations

import numpy as np

from dpm2_core.geometry import se3
from dpm2_core.geometry.voxel import voxel_first
from dpm2_core.slam.store.cloud_codec import pack_cloud
from dpm2_core.slam.store.cloud_store import CloudStore
from dpm2_core.slam.store.map_cloud import map_cloud, map_cloud_in_steps


def test_it_is_the_first_point_in_each_voxel_made_in_steps() -> None:
    """The number of clouds that are thinned at once does not matter. Nodes that are not requested are not in it."""
    noise, clouds = np.random.default_rng(0), CloudStore()
    poses = se3.exp(np.arange(230)[:, None] * np.array([0, 0, 0.01, 0.5, 0, 0]))
    for _ in poses:
        clouds.append(pack_cloud(noise.uniform(-5, 5, (40, 4)).astype(np.float32)))
    for nodes in ([], range(20), range(0, 230, 2), range(230)):
        every = np.concatenate([np.zeros((0, 4), np.float32), *(se3.transform(poses[n], clouds[n]) for n in nodes)])
        steps = sum(1 for _ in map_cloud_in_steps(clouds, poses, 0.5, nodes))
        assert steps == len(nodes) // 50
        np.testing.assert_array_equal(map_cloud(clouds, poses, 0.5, nodes), every[voxel_first(every, 0.5)])
    np.testing.assert_array_equal(map_cloud(clouds, poses, 0.5), map_cloud(clouds, poses, 0.5, range(230)))
