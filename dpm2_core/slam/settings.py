# SPDX-License-Identifier: Apache-2.0
"""Settings of the SLAM, stage by stage, and of `dpm2 run`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import Field, model_validator

from dpm2_core.config import Settings, merged, read_yaml
from dpm2_core.data.settings import InputSettings
from dpm2_core.network.pretrained import weights_id
from dpm2_core.slam.filters import FilterSettings
from dpm2_core.slam.graph.robust import RobustSettings
from dpm2_core.slam.loops.closure import LoopSettings
from dpm2_core.slam.loops.relocalization import RelocalizationSettings
from dpm2_core.slam.loops.verification import VerificationSettings
from dpm2_core.slam.mapping.mapper import MapSettings
from dpm2_core.slam.odometry.keyframe_selection import KeyframeSettings
from dpm2_core.slam.odometry.settings import OdometrySettings
from dpm2_core.slam.preprocess import PreprocessSettings
from dpm2_core.slam.registration.icp import GeometricSettings
from dpm2_core.slam.registration.local_map import LocalMapSettings
from dpm2_core.slam.registration.neural import NeuralSettings
from dpm2_core.slam.registration.texture import VisualSettings


class SlamSettings(Settings):
    """The SLAM, stage by stage."""

    preset: Literal["auto", "outdoor", "indoor", "highway", "paper"] = "auto"
    """Changes to the other defaults of `slam`. What is set besides has precedence; but where a preset is set over a
    file, values that are those of the file's own preset give way. indoor: rooms and corridors at a walk. highway: far
    and fast. outdoor: no change. auto: indoor where the scans show rooms, else outdoor. paper: the SLAM of
    DeepPointMap2 as published, by the network alone (docs/experiments.md)."""
    registration: Literal["geometric", "neural", "refined", "adaptive"] = "adaptive"
    """How a scan finds its pose: by points, by neural descriptors, by both (refined), or by points that ask the network
    where they do not know (adaptive): where few of them fit, as at few frames per second, and along a tunnel."""
    threads: int = Field(1, ge=1)
    """Threads of the network. More are faster where processors are idle; on busy ones they wait for each other."""
    filter: FilterSettings = FilterSettings()
    preprocess: PreprocessSettings = PreprocessSettings()
    geometric: GeometricSettings = GeometricSettings()
    neural: NeuralSettings = NeuralSettings()
    visual: VisualSettings = VisualSettings()
    local_map: LocalMapSettings = LocalMapSettings()
    odometry: OdometrySettings = OdometrySettings()
    keyframes: KeyframeSettings = KeyframeSettings()
    loops: LoopSettings = LoopSettings()
    relocalise: RelocalizationSettings = RelocalizationSettings()
    verification: VerificationSettings = VerificationSettings()
    pose_graph: RobustSettings = RobustSettings()
    map: MapSettings = MapSettings()

    @model_validator(mode="before")
    @classmethod
    def _with_preset(cls, given: Any) -> Any:
        """What the preset changes, under what is given."""
        changes = _changes(given.get("preset")) if isinstance(given, Mapping) else {}
        if not changes:
            return given
        values = {k: v.model_dump(exclude_unset=True) if isinstance(v, Settings) else v for k, v in given.items()}
        return merged(changes, values)

    @classmethod
    def implied(cls, tree: Mapping[str, Any]) -> dict[str, Any]:
        """The values of the preset that a tree names; see `Settings.implied`."""
        preset = tree.get("preset", "auto")
        if preset not in get_args(cls.model_fields["preset"].annotation):
            return {}  # which is an error, or another one takes its place
        return cls(preset=preset).model_dump(mode="json", exclude={"preset"})

    def indoors(self) -> SlamSettings:
        """What is used in rooms: with `preset: auto` the preset for rooms under what differs from the defaults.

        An upper bound of the preset gives way to a lower one that is set.
        """
        if self.preset != "auto":
            return self
        room = merged(_changes("indoor"), self.model_dump(exclude_defaults=True))
        part = room["preprocess"]
        part["source_voxel"] = max(part["source_voxel"], part["map_voxel"])
        if part["min_range"] >= part["max_range"]:
            part["max_range"] = self.preprocess.max_range
        return SlamSettings.model_validate({**room, "preset": "indoor"})

    @property
    def uses_descriptors(self) -> bool:
        """Whether keyframes may have descriptors, which only those of the same weights can be compared with."""
        return self.registration != "geometric" or (self.loops.enabled and self.loops.descriptors)

    def weights_id(self) -> str:
        """Of the weights that make descriptors, see `network.pretrained.weights_id`; empty where none are made."""
        return weights_id(self.neural.weights) if self.uses_descriptors else ""


def _changes(preset: Any) -> dict[str, Any]:
    """What a preset changes; nothing for what is no name of one."""
    named = preset in get_args(SlamSettings.model_fields["preset"].annotation)[1:]
    return read_yaml(Path(__file__).with_name("presets") / f"{preset}.yaml") if named else {}


class Config(Settings):
    """All settings of `dpm2 run`."""

    input: InputSettings = InputSettings()
    slam: SlamSettings = SlamSettings()
