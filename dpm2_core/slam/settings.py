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
    """A set of changes to the other defaults of `slam`. A value that is set explicitly has precedence over the preset.
    If another preset is set than the one in a file, values of the file that are those of its own preset are replaced.
    indoor: rooms and corridors at walking speed. highway: long ranges and high speed. outdoor: no change. auto: indoor
    where the scans show rooms, else outdoor. paper: the SLAM of DeepPointMap2 as published, by the network alone
    (docs/experiments.md)."""
    registration: Literal["geometric", "neural", "refined", "adaptive"] = "adaptive"
    """How the pose of a scan is found: by points, by neural descriptors, by both (refined), or by points with the
    network as a fallback (adaptive): where few points fit, as at low frame rates, and along a tunnel."""
    threads: int = Field(1, ge=1)
    """Threads of the network. More threads are faster on idle processors; on busy ones they wait for each other."""
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
        """The changes of the preset, overridden by the given values."""
        changes = _preset_changes(given.get("preset")) if isinstance(given, Mapping) else {}
        if not changes:
            return given
        values = {k: v.model_dump(exclude_unset=True) if isinstance(v, Settings) else v for k, v in given.items()}
        return merged(changes, values)

    @classmethod
    def implied(cls, tree: Mapping[str, Any]) -> dict[str, Any]:
        """The values of the preset that a tree names; see `Settings.implied`."""
        preset = tree.get("preset", "auto")
        if preset not in get_args(cls.model_fields["preset"].annotation):
            return {}  # an invalid name is reported elsewhere, or another preset replaces it
        return cls(preset=preset).model_dump(mode="json", exclude={"preset"})

    def indoors(self) -> SlamSettings:
        """The settings for rooms: with `preset: auto`, the indoor preset overridden by all values that differ from the
        defaults.

        An upper bound of the preset is raised if a lower bound that is set is above it.
        """
        if self.preset != "auto":
            return self
        room = merged(_preset_changes("indoor"), self.model_dump(exclude_defaults=True))
        preprocess = room["preprocess"]
        preprocess["source_voxel"] = max(preprocess["source_voxel"], preprocess["map_voxel"])
        if preprocess["min_range"] >= preprocess["max_range"]:
            preprocess["max_range"] = self.preprocess.max_range
        return SlamSettings.model_validate({**room, "preset": "indoor"})

    @property
    def uses_descriptors(self) -> bool:
        """Whether keyframes may have descriptors; these can only be compared with descriptors of the same weights."""
        return self.registration != "geometric" or (self.loops.enabled and self.loops.descriptors)

    def weights_id(self) -> str:
        """Id of the weights that make descriptors, see `network.pretrained.weights_id`; empty if none are made."""
        return weights_id(self.neural.weights) if self.uses_descriptors else ""


def _preset_changes(preset: Any) -> dict[str, Any]:
    """The changes of a preset; empty if there is no preset with that name."""
    named = preset in get_args(SlamSettings.model_fields["preset"].annotation)[1:]
    return read_yaml(Path(__file__).with_name("presets") / f"{preset}.yaml") if named else {}


class Config(Settings):
    """All settings of `dpm2 run`."""

    input: InputSettings = InputSettings()
    slam: SlamSettings = SlamSettings()
