# SPDX-License-Identifier: Apache-2.0
"""AE_lidar: its size, the variational one by its definition, and small trainings of both."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch.distributions import Normal, kl_divergence

from dpm2_core.diffslam import ScheduleSettings, SlamLossSettings
from dpm2_core.errors import UsageError
from dpm2_core.learning.checkpoint import WEIGHTS, read_log
from dpm2_core.network.perception.range_image import RangeImageSettings
from dpm2_core.tasks.ae_lidar import AeLidarSettings, LidarAutoencoder
from dpm2_core.tasks.ae_lidar_task import AeLidarTask, AeLidarTraining
from dpm2_core.tasks.open import open_scans
from dpm2_core.tasks.training import draw, load_task, measure, new_task, train_task

SENSOR = RangeImageSettings(beams=((2.0, -14.0, 16),), first=0, rows=16, columns=64, scale=60.0)


def network(**changes: object) -> AeLidarSettings:
    return AeLidarSettings.model_validate({"image": SENSOR, "channels": 8, "latent": 32} | changes)


def training(**changes: object) -> AeLidarTraining:
    small: dict[str, object] = {
        "network": network(), "window": 4, "every": 1, "batch": 2, "optimiser": {"warmup": 5, "rate": 3e-3},
        "epochs": 10, "slam_loss": SlamLossSettings(points=300),
    }  # fmt: skip
    return AeLidarTraining.model_validate(small | changes)


def test_size_is_that_of_the_paper() -> None:
    """21.2 million parameters; 40 x 256 in and out."""
    net = LidarAutoencoder().eval()
    assert sum(p.numel() for p in net.parameters()) == pytest.approx(21.2e6, rel=3e-3)
    assert net(torch.rand(1, 2, 40, 256))[0].shape == (1, 2, 40, 256)


@pytest.mark.parametrize(("rows", "columns"), [(16, 64), (24, 128), (32, 512), (64, 64)])
def test_other_sensors_fit(rows: int, columns: int) -> None:
    """This includes odd and even numbers of rows after three halvings."""
    image = RangeImageSettings(beams=((2, -25, 64),), first=0, rows=rows, columns=columns)
    assert LidarAutoencoder(network(image=image)).eval()(torch.rand(2, 2, rows, columns))[0].shape[2:] == (
        rows,
        columns,
    )


@pytest.mark.parametrize("rows", [8, 41])
def test_rows_that_cannot_be_halved_are_rejected(rows: int) -> None:
    """The message gives the number."""
    image = RangeImageSettings(first=0, rows=rows)
    with pytest.raises(UsageError, match=f"images of {rows} rows; want a multiple of 8"):
        LidarAutoencoder(network(image=image))


def test_divergence_of_the_vae_is_that_of_its_distributions() -> None:
    """It equals that of torch.distributions; codes are sampled in training, and are the mean otherwise."""
    torch.manual_seed(0)
    net = LidarAutoencoder(network(variational=True)).eval()
    images = torch.rand(3, 2, 16, 64)
    code, divergence = net.encode(images)
    mean, log_variance = net.encoder(images)[:, :, 0, 0].chunk(2, 1)
    requested = kl_divergence(Normal(mean, (log_variance / 2).exp()), Normal(0.0, 1.0)).sum(1)
    torch.testing.assert_close(divergence, requested)
    torch.testing.assert_close(code, mean)
    net.train()
    assert not torch.equal(net.encode(images)[0], net.encode(images)[0])
    assert not LidarAutoencoder(network()).encode(images)[1].any()


def test_divergence_counts_for_more_with_every_epoch(pairs: Path) -> None:
    """The same scans and noise, in one epoch compared with the last epoch of the warm-up."""
    task = AeLidarTask(training(network=network(variational=True), divergence_warmup=4)).train()
    scans = [open_scans(pairs)[i] for i in range(8)]
    values = []
    for epoch in (0, 3, 9):
        torch.manual_seed(1)
        task.start_epoch(epoch)
        values.append(task.losses(scans)[0].item())
    assert values[0] < values[1]
    assert values[1] == pytest.approx(values[2])
    assert values[1] - values[0] == pytest.approx(0.75 * 5.0, rel=0.05)  # an untrained one is below the minimum


@pytest.mark.slow
@pytest.mark.parametrize("variational", [False, True])
def test_learns_and_can_be_loaded(pairs: Path, tmp_path: Path, variational: bool) -> None:
    """The loss falls to less than half with the SLAM loss on; the saved weights give figures, clouds and an image."""
    scans = open_scans(pairs)
    settings = training(network=network(variational=variational), slam=ScheduleSettings(gamma=1.0, every=5))
    task = train_task(new_task("ae_lidar", settings), scans, tmp_path)
    log = read_log(tmp_path)
    assert log[-1]["task_loss"] < 0.5 * log[0]["task_loss"]
    assert [row["step"] for row in log if row.get("slam_loss") is not None] == [8, 9, 18, 19]
    figures = measure(task, scans)
    assert figures.keys() == {"chamfer_m", "chamfer", "d_error_m", "varies_m", "target_varies_m"}
    assert all(value > 0 for value in figures.values())
    with torch.no_grad():
        assert task.clouds(scans[0])["output"].shape == task.clouds(scans[0])["input"].shape
    draw(task, scans, 0, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
    loaded = load_task("ae_lidar", tmp_path / WEIGHTS)
    image = torch.rand(1, 2, 16, 64)
    torch.testing.assert_close(loaded.network(image)[0], task.network(image)[0])
