# SPDX-License-Identifier: Apache-2.0
"""The recipes in config/ fit the settings classes that read them."""

from __future__ import annotations

from pathlib import Path

import pytest

from dpm2_core.config import Settings, load_settings
from dpm2_core.experiments.ablation import AblationSettings
from dpm2_core.experiments.variants import AS_PAPER, TABLE_4
from dpm2_core.learning.augment import UNCHANGED
from dpm2_core.learning.train_image import ImageTrainingSettings
from dpm2_core.learning.train_overlap import OverlapTrainingSettings
from dpm2_core.learning.train_registration import RegistrationTrainingSettings
from dpm2_core.network.settings import preset
from dpm2_core.sim.settings import HDL64E
from dpm2_core.tasks.drives import TaskDriveSettings

CONFIG = Path(__file__).parents[3] / "config"
READ_BY: dict[str, type[Settings]] = {
    "ablation": AblationSettings,
    "ablation_paper": AblationSettings,
    "ablation_start": RegistrationTrainingSettings,
    "movers_drives": TaskDriveSettings,
    "train_paper_overlap": OverlapTrainingSettings,
    "train_paper_registration": RegistrationTrainingSettings,
    "train_small": RegistrationTrainingSettings,
    "train_small_camera": RegistrationTrainingSettings,
    "train_small_corners": RegistrationTrainingSettings,
    "train_small_image": ImageTrainingSettings,
    "train_small_light": RegistrationTrainingSettings,
    "train_small_far": RegistrationTrainingSettings,
    "train_small_phase2": OverlapTrainingSettings,
    "train_small_pose": RegistrationTrainingSettings,
    "train_small_real": RegistrationTrainingSettings,
    "train_small_rooms": RegistrationTrainingSettings,
}


@pytest.mark.parametrize("name", sorted(READ_BY))
def test_every_key_of_a_recipe_is_a_setting(name: str) -> None:
    load_settings(READ_BY[name], CONFIG / f"{name}.yaml")


def test_no_recipe_of_the_network_is_forgotten_here() -> None:
    assert {path.stem for kind in ("train", "ablation") for path in CONFIG.glob(f"{kind}*.yaml")} <= set(READ_BY)


def test_the_sensor_of_the_dynamic_objects_drives_is_the_simulators_own() -> None:
    """YAML cannot refer to it by name, so the recipe repeats it."""
    assert load_settings(TaskDriveSettings, CONFIG / "movers_drives.yaml").lidar == HDL64E


def test_both_ablations_differ_in_the_fusion_and_in_how_long_they_train() -> None:
    """Thus the two tables can be compared."""
    shipped, paper = (
        load_settings(AblationSettings, CONFIG / f"{name}.yaml") for name in ("ablation", "ablation_paper")
    )
    assert paper.training.network["fusion"] == {**shipped.training.network["fusion"], **AS_PAPER["fusion"]}
    network = {**paper.training.network, "fusion": shipped.training.network["fusion"]}
    optimiser = paper.training.optimiser.model_copy(update={"steps": shipped.training.optimiser.steps})
    assert paper.training.model_copy(update={"network": network, "optimiser": optimiser}) == shipped.training
    assert (paper.measure, paper.seeds, paper.pairs) == (shipped.measure, shipped.seeds, shipped.pairs)
    assert paper.variants == TABLE_4


def test_the_recipes_of_the_paper_are_of_its_network_and_fit_each_other() -> None:
    first = load_settings(RegistrationTrainingSettings, CONFIG / "train_paper_registration.yaml")
    second = load_settings(OverlapTrainingSettings, CONFIG / "train_paper_overlap.yaml")
    assert preset(first.preset) == preset("paper")
    assert first.data.packed == second.data.packed
    assert second.start == "out/paper/registration/weights.safetensors"
    assert second.optimiser.rate == pytest.approx(first.optimiser.rate / 10)
    assert second.optimiser.decay == pytest.approx(first.optimiser.decay / 10)
    assert (first.loss.pairing, first.loss.coarse, first.loss.backbone, first.loss.offset) == (1, 0.1, 0.1, 1)


@pytest.mark.parametrize("name", ["train_paper_registration", "train_paper_overlap"])
def test_the_recipes_of_the_paper_change_scans_as_its_predecessor_and_leave_images_as_they_are(name: str) -> None:
    """The defaults would also change exposure, colors and calibration at random."""
    settings = load_settings(READ_BY[name], CONFIG / f"{name}.yaml").data.augment
    changed = {key for key, value in settings if value != getattr(UNCHANGED, key)}
    assert changed == {"drop", "occlusion", "jitter", "yaw", "tilt", "shift"}


def test_the_papers_network_has_its_reference_points() -> None:
    """They are the farthest ones, as in v1. Previously, the paper's preset had half of them on edges and corners, as
    `small` does."""
    assert [preset(name).fusion.reference for name in ("paper", "v1")] == ["fps", "fps"]
