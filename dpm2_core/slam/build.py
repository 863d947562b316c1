# SPDX-License-Identifier: Apache-2.0
"""Builds the parts of the SLAM from its settings."""

from __future__ import annotations

from dpm2_core.network.pretrained import load_network
from dpm2_core.slam.filters import make_filter
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.loops.closure import LoopCloser
from dpm2_core.slam.loops.localizer import Localizer
from dpm2_core.slam.loops.relocalization import Relocalizer
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.odometry.keyframe_selection import KeyframeSelector
from dpm2_core.slam.odometry.odometry import Odometry
from dpm2_core.slam.preprocess import Preprocessor
from dpm2_core.slam.registration.fused import RefinedScanRegistration
from dpm2_core.slam.registration.icp import GeometricRegistration
from dpm2_core.slam.registration.local_map import LocalMap
from dpm2_core.slam.registration.neural import NeuralScanRegistration
from dpm2_core.slam.registration.points import GeometricScanRegistration
from dpm2_core.slam.registration.protocol import ScanRegistration
from dpm2_core.slam.registration.visual import VisualScanRegistration
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.map_store import MapStore


def make_odometry(s: SlamSettings, robot: str = "") -> Odometry:
    """The odometry with its collaborators."""
    return Odometry(s.odometry, make_registration(s), KeyframeSelector(s.keyframes, robot))


def make_registration(s: SlamSettings) -> ScanRegistration:
    """What `registration` names.

    Raises:
        UsageError: the network, or that of the filter, has no weights to run with.
    """
    preprocessor = Preprocessor(s.preprocess, make_filter(s.filter, s.threads))
    geometric = GeometricScanRegistration(
        preprocessor, GeometricRegistration(s.geometric), LocalMap(s.local_map, s.threads)
    )
    chosen: ScanRegistration = geometric
    if s.registration != "geometric":
        network = load_network(s.neural.weights, s.threads, s.neural.preset)
        neural = NeuralScanRegistration(s.neural, preprocessor, network)
        chosen = neural if s.registration == "neural" else RefinedScanRegistration(neural, geometric)
    return VisualScanRegistration(s.visual, chosen) if s.visual.enabled else chosen


def make_mapper(s: SlamSettings, store: MapStore | None = None) -> Mapper:
    """The mapper with its collaborators; with a map file, if there is one."""
    return Mapper(s.map, PoseGraph(s.pose_graph), make_loops(s), store)


def make_localizer(s: SlamSettings, mapper: Mapper) -> Localizer:
    """Finds keyframes in the map that a mapper has loaded.

    Raises:
        UsageError: the network has no weights to run with.
    """
    network = load_network(s.neural.weights, s.threads, s.neural.preset)
    relocalizer = Relocalizer(
        s.relocalise, s.geometric, network, mapper.keyframes, mapper.clouds, mapper.poses, s.threads
    )
    return Localizer(relocalizer, s.relocalise.max_failures)


def make_loops(s: SlamSettings) -> LoopCloser:
    """The loop closer, with a network if it is to use descriptors.

    Raises:
        UsageError: the network has no weights to run with.
    """
    network = None
    if s.loops.enabled and s.loops.descriptors:
        network = load_network(s.neural.weights, s.threads, s.neural.preset)
    return LoopCloser(s.loops, s.geometric, s.threads, network)
