# SPDX-License-Identifier: Apache-2.0
"""The only factory: creates the SLAM or one of its parts from settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dpm2_core.errors import UsageError
from dpm2_core.geometry.scale import ByScale
from dpm2_core.network.pretrained import load_network
from dpm2_core.slam.filters import make_filter
from dpm2_core.slam.graph.pose_graph import PoseGraph
from dpm2_core.slam.loops.closure import LoopCloser
from dpm2_core.slam.loops.localizer import Localizer
from dpm2_core.slam.loops.pictures import KnownMap
from dpm2_core.slam.loops.place_recognition import PlaceRecognition
from dpm2_core.slam.loops.relocalization import Relocalizer
from dpm2_core.slam.loops.verification import Verifier
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.mapping.tiles import TiledMap, TiledRelocalizer
from dpm2_core.slam.odometry.odometry import Odometry, Tools
from dpm2_core.slam.odometry.scaled import ScaledOdometry
from dpm2_core.slam.preprocess import Preprocessor
from dpm2_core.slam.registration.fused import FusedScanRegistration
from dpm2_core.slam.registration.icp import GeometricRegistration, GeometricScanRegistration
from dpm2_core.slam.registration.local_map import LocalMap
from dpm2_core.slam.registration.neural import NeuralScanRegistration
from dpm2_core.slam.registration.protocol import ScanRegistration
from dpm2_core.slam.registration.visual import VisualScanRegistration
from dpm2_core.slam.settings import SlamSettings
from dpm2_core.slam.store.map_data import MapData
from dpm2_core.slam.store.map_store import MapStore
from dpm2_core.slam.system import Slam

if TYPE_CHECKING:  # torch takes seconds to import
    from dpm2_core.network.model import DeepPointMap2


def make_slam(
    settings: SlamSettings | None = None,
    robot: str = "",
    store: MapStore | TiledMap | None = None,
    background: bool = False,
) -> Slam:
    """The SLAM with all its parts.

    Args:
        robot: namespace of its keyframes, "" for a single robot.
        store: the map file. Either one to write or continue, with its session begun (`open_session`); or one that is
            open for reading only (`open_for_localization`), which may be a folder of tiles, for localization. None: the
            map is in memory, its clouds in a temporary file.
        background: a large pose graph is optimized in another process during the drive, as on a real robot; the result
            then depends on timing.

    Raises:
        UsageError: a network has no weights, or the settings are of another type.
    """
    s = settings or SlamSettings()
    odometry = make_odometry(s, robot)
    pictured = s.odometry.degraded_sigma if s.visual.enabled else None
    return Slam(odometry, *make_map(s, store, background), s.map.thumbnail, pictured)


def make_map(
    s: SlamSettings, store: MapStore | TiledMap | None = None, background: bool = False
) -> tuple[Mapper, Localizer | None]:
    """The mapper and, for a map that must not change, its localizer; arguments as for `make_slam`.

    The mapper of a folder of tiles is empty: the tiles are never all in memory.
    """
    if isinstance(store, TiledMap):
        return make_mapper(s), make_tiled_localizer(s, store)
    mapper = make_mapper(s, store, background)
    return mapper, make_localizer(s, mapper) if store is not None and store.read_only else None


def make_odometry(s: SlamSettings, robot: str = "") -> Odometry:
    """The odometry with its tools; with `preset: auto` the tools for streets and those for rooms.

    Raises:
        UsageError: as `make_slam`.
    """
    if not isinstance(s, SlamSettings):
        raise UsageError(f"want SlamSettings, which a Config has as its slam, not {type(s).__name__}")
    if s.preset == "auto":
        return ScaledOdometry(ByScale(_tools(s), _tools(s.indoors())), robot)
    return Odometry(_tools(s), robot)


def _tools(s: SlamSettings) -> Tools:
    return Tools(s.odometry, make_registration(s), s.keyframes)


def make_registration(s: SlamSettings) -> ScanRegistration:
    """The registration that the setting `registration` names.

    Raises:
        UsageError: the network, or that of the filter, has no weights.
    """
    preprocessor = Preprocessor(s.preprocess, make_filter(s.filter, s.threads))
    local_map = LocalMap(s.local_map, s.preprocess.map_voxel)
    geometric = GeometricScanRegistration(preprocessor, GeometricRegistration(s.geometric), local_map)
    chosen: ScanRegistration = geometric
    if s.registration != "geometric":
        neural = NeuralScanRegistration(s.neural, preprocessor, _network(s))
        chosen = (
            neural
            if s.registration == "neural"
            else FusedScanRegistration(neural, geometric, s.registration == "refined")
        )
    return VisualScanRegistration(s.visual, chosen, s.odometry.degraded_sigma) if s.visual.enabled else chosen


def make_mapper(s: SlamSettings, store: MapStore | None = None, background: bool = False) -> Mapper:
    """The mapper with its collaborators, and the map file if there is one."""
    return Mapper(s.map, PoseGraph(s.pose_graph, background), make_loops(s), store)


def make_localizer(s: SlamSettings, mapper: Mapper) -> Localizer:
    """Localizes keyframes in the map that a mapper has loaded.

    Raises:
        UsageError: the network has no weights.
    """
    placed, loan = mapper.placed, mapper.clouds.loan  # the pose in the map is known only for placed keyframes
    # One keyframe per place that was passed several times: else all candidates, and the map around, would be of it.
    lenders = ((node, lent.lender if (lent := loan(node)) else None) for node in np.flatnonzero(placed).tolist())
    nodes = [node for node, lender in lenders if lender is None or not placed[lender]]
    known = KnownMap(
        [mapper.keyframes[node] for node in nodes],
        lambda i: mapper.clouds[nodes[i]],
        mapper.poses[nodes],
        lambda i: mapper.thumbnail(nodes[i]),
    )
    relocalizer = Relocalizer(s.relocalise, s.visual, _verifiers(s), _network(s), known)
    return Localizer(relocalizer)


def make_tiled_localizer(s: SlamSettings, tiles: TiledMap) -> Localizer:
    """Localizes keyframes in a map of which only the surroundings are in memory.

    Raises:
        UsageError: the network has no weights.
    """
    verifiers, network = _verifiers(s), _network(s)

    def make_relocalizer(data: MapData) -> Relocalizer:
        known = KnownMap(data.keyframes, data.clouds.item, data.poses, data.thumbnail)
        return Relocalizer(s.relocalise, s.visual, verifiers, network, known)

    relocalizer = TiledRelocalizer(s.relocalise, tiles, make_relocalizer, PlaceRecognition(network).descriptors)
    return Localizer(relocalizer)


def _verifiers(s: SlamSettings) -> ByScale[Verifier]:
    return ByScale(*(make_verifier(one) for one in (s, s.indoors())))


def make_verifier(s: SlamSettings) -> Verifier:
    """Checks a proposed pose with the points."""
    return Verifier(s.verification, s.geometric, s.preprocess)


def make_loops(s: SlamSettings) -> LoopCloser:
    """The loop closer, with a network if it uses descriptors.

    Raises:
        UsageError: the network has no weights.
    """
    described = s.loops.enabled and s.loops.descriptors
    by_scene = ByScale(*((one.loops, make_verifier(one)) for one in (s, s.indoors())))
    return LoopCloser(by_scene, _network(s) if described else None)


def _network(s: SlamSettings) -> DeepPointMap2:
    """One network for registration, loops and relocalization."""
    network = load_network(s.neural.weights, s.threads)
    network.solver = s.neural.solver
    return network
