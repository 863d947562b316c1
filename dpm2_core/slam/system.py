# SPDX-License-Identifier: Apache-2.0
"""The whole SLAM: odometry makes keyframes, the mapper makes them consistent. Synchronous and deterministic."""

from __future__ import annotations

from time import perf_counter
from typing import Literal

from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.data.settings import InputSettings
from dpm2_core.frame import Frame, Tracked
from dpm2_core.network.pretrained import load_network
from dpm2_core.slam.filters import FilterSettings, make_filter
from dpm2_core.slam.graph.pose_graph import PoseGraph, PoseGraphSettings
from dpm2_core.slam.loops.closure import LoopCloser, LoopSettings
from dpm2_core.slam.loops.localizer import Localiser, Located
from dpm2_core.slam.loops.relocalization import Relocaliser, RelocaliseSettings
from dpm2_core.slam.mapping.mapper import Mapper, MapSettings, thumbnail
from dpm2_core.slam.odometry.keyframe_selection import KeyframeSelector, KeyframeSettings
from dpm2_core.slam.odometry.odometry import Odometry, OdometrySettings
from dpm2_core.slam.preprocess import Preprocessor, PreprocessSettings
from dpm2_core.slam.registration.fused import RefinedScanRegistration
from dpm2_core.slam.registration.icp import GeometricRegistration, GeometricSettings
from dpm2_core.slam.registration.local_map import LocalMap, LocalMapSettings
from dpm2_core.slam.registration.neural import NeuralScanRegistration, NeuralSettings
from dpm2_core.slam.registration.protocol import GeometricScanRegistration, ScanRegistration
from dpm2_core.slam.registration.visual import VisualScanRegistration, VisualSettings
from dpm2_core.slam.store.map_store import MapStore


class SlamSettings(Settings):
    """The SLAM, stage by stage."""

    registration: Literal["geometric", "neural", "refined"] = "geometric"
    """How a scan finds its pose: by points, by neural descriptors, or by both."""
    threads: int = Field(2, ge=1)
    """Threads of the neighbour search and of the network."""
    filter: FilterSettings = FilterSettings()
    preprocess: PreprocessSettings = PreprocessSettings()
    geometric: GeometricSettings = GeometricSettings()
    neural: NeuralSettings = NeuralSettings()
    visual: VisualSettings = VisualSettings()
    local_map: LocalMapSettings = LocalMapSettings()
    odometry: OdometrySettings = OdometrySettings()
    keyframes: KeyframeSettings = KeyframeSettings()
    loops: LoopSettings = LoopSettings()
    relocalise: RelocaliseSettings = RelocaliseSettings()
    pose_graph: PoseGraphSettings = PoseGraphSettings()
    map: MapSettings = MapSettings()


class Config(Settings):
    """Everything that `dpm2 run` can be told."""

    input: InputSettings = InputSettings()
    slam: SlamSettings = SlamSettings()


class SlamSystem:
    """One robot: `odometry` runs on every frame, `mapper` on every keyframe; the ROS node runs them in two threads."""

    def __init__(self, settings: SlamSettings | None = None, robot: str = "", store: MapStore | None = None) -> None:
        """`store`: the map file to write, or to go on with; its session has begun."""
        self._settings = settings or SlamSettings()
        self.odometry = make_odometry(self._settings, robot)
        self.mapper = make_mapper(self._settings, store)

    def process(self, frame: Frame) -> Tracked:
        """Take one frame in: its pose in the odometry frame, and the map one keyframe richer when it shows enough."""
        tracked = self.odometry.process(frame)
        started = perf_counter()
        if tracked.keyframe is not None:
            self.mapper.add(tracked.keyframe, thumbnail(frame, self._settings.map.thumbnail))
        tracked.seconds["map"] = perf_counter() - started
        return tracked

    def reset(self) -> None:
        """Begin anew, with an empty map; one in a file stays as it is."""
        self.odometry.reset()
        self.mapper = make_mapper(self._settings)


class LocalisationSystem:
    """One robot in a map that stays as it is: `odometry` runs on every frame, `localiser` on every keyframe."""

    def __init__(self, settings: SlamSettings, store: MapStore, robot: str = "") -> None:
        """`store`: the map file, open for reading only, see `open_for_localisation`."""
        self.odometry = make_odometry(settings, robot)
        self.mapper = make_mapper(settings, store)
        self.localiser = make_localiser(settings, self.mapper)

    def process(self, frame: Frame) -> tuple[Tracked, Located | None]:
        """Take one frame in: its pose in the odometry frame, and, when it became a keyframe, its place in the map.

        While the localiser's `state.located`, `T_map_odom @ T_odom_lidar` is the frame's pose in the map.
        """
        if self.localiser.wants(frame.stamp):
            self.odometry.request_keyframe()
        tracked = self.odometry.process(frame)
        started = perf_counter()
        located = None if tracked.keyframe is None else self.localiser.add(tracked.keyframe)
        tracked.seconds["localise"] = perf_counter() - started
        return tracked, located


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


def make_localiser(s: SlamSettings, mapper: Mapper) -> Localiser:
    """Finds keyframes in the map that a mapper has loaded.

    Raises:
        UsageError: the network has no weights to run with.
    """
    network = load_network(s.neural.weights, s.threads, s.neural.preset)
    relocaliser = Relocaliser(
        s.relocalise, s.geometric, network, mapper.keyframes, mapper.clouds, mapper.poses, s.threads
    )
    return Localiser(relocaliser, s.relocalise.max_failures)


def make_loops(s: SlamSettings) -> LoopCloser:
    """The loop closer, with a network if it is to use descriptors.

    Raises:
        UsageError: the network has no weights to run with.
    """
    network = None
    if s.loops.enabled and s.loops.descriptors:
        network = load_network(s.neural.weights, s.threads, s.neural.preset)
    return LoopCloser(s.loops, s.geometric, s.threads, network)
