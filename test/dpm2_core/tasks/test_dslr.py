# SPDX-License-Identifier: Apache-2.0
"""DSLR: sizes, what each stage trains and does not change, the target of the SLAM loss, and a small training."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import nn

from dpm2_core.diffslam import ScheduleSettings, SlamLossSettings
from dpm2_core.errors import UsageError
from dpm2_core.learning.checkpoint import WEIGHTS, read_log
from dpm2_core.network.perception.dslr import Dslr, DslrSettings, PairDiscriminator, RangeDecoder, RangeEncoder, load
from dpm2_core.network.perception.range_image import RangeImageSettings
from dpm2_core.network.weights import read_tensors
from dpm2_core.tasks.dslr_task import DslrTask, DslrTraining
from dpm2_core.tasks.open import open_scans
from dpm2_core.tasks.range_scans import RangeReader
from dpm2_core.tasks.scan import TaskScan, TaskScans
from dpm2_core.tasks.training import draw, measure, new_task, train_task

SENSOR = RangeImageSettings(beams=((2.0, -14.0, 16),), first=0, rows=16, columns=64, scale=60.0)
NETWORK = DslrSettings(image=SENSOR, channels=8, latent=16)


def training(**changes: object) -> DslrTraining:
    """Settings of a small, fast training."""
    small: dict[str, object] = {
        "network": NETWORK, "window": 4, "every": 1, "batch": 2, "optimiser": {"warmup": 5, "rate": 3e-3},
        "slam_loss": SlamLossSettings(points=300), "autoencoder_epochs": 1, "discriminator_epochs": 1, "epochs": 3,
    }  # fmt: skip
    return DslrTraining.model_validate(small | changes)


def parameters(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def test_sizes_are_those_of_the_paper() -> None:
    """Encoder 2.544 M, decoder 2.987 M, discriminator 68 k parameters; 40 x 256 in and out."""
    settings = DslrSettings()
    assert parameters(RangeEncoder(settings)) == 2_544_384
    assert parameters(RangeDecoder(settings)) == 2_986_624
    assert parameters(PairDiscriminator(settings)) == 68_321
    assert Dslr(settings).eval()(torch.rand(1, 2, 40, 256)).shape == (1, 2, 40, 256)


@pytest.mark.parametrize(("rows", "columns"), [(16, 64), (24, 512), (41, 128), (42, 64), (4, 64)])
def test_other_sensors_fit(rows: int, columns: int) -> None:
    """Any number of rows up to 42, and columns in multiples of 64; the values are in -1..1."""
    image = RangeImageSettings(beams=((2, -25, 64),), first=0, rows=rows, columns=columns)
    made = Dslr(DslrSettings(image=image, channels=4, latent=8)).eval()(torch.rand(2, 2, rows, columns))
    assert made.shape == (2, 2, rows, columns)
    assert made.abs().max() <= 1


def test_too_many_rows_are_rejected() -> None:
    """The decoder makes 42 rows."""
    with pytest.raises(UsageError, match="images of 64 rows; want at most 42"):
        Dslr(DslrSettings(image=RangeImageSettings(first=0, rows=64)))


def gradients(task: DslrTask) -> set[str]:
    """Names of the networks that the loss of one step reaches."""
    return {
        name
        for name, part in task.network.named_children()
        if any(p.grad is not None and bool(p.grad.any()) for p in part.parameters())
    }


@pytest.mark.parametrize(
    ("epoch", "reached"),
    [
        (0, {"static_encoder", "decoder"}),
        (1, {"static_encoder", "decoder", "discriminator"}),
        (2, {"dynamic_encoder"}),
    ],
)
def test_each_stage_trains_its_own_part(pairs: Path, epoch: int, reached: set[str]) -> None:
    """Frozen parts receive no gradients, and in the third stage their running means do not change."""
    torch.manual_seed(0)
    task = DslrTask(training())
    scans = open_scans(pairs)
    task.train()
    task.start_epoch(epoch)
    before = {name: value.clone() for name, value in task.network.state_dict().items()}
    loss, slam = task.losses([scans[i] for i in (0, 1, 2, 3, 8, 9, 10, 11)])
    loss.backward()
    assert gradients(task) == reached
    assert (slam is not None) == (epoch == 2)
    changed = {name for name, value in task.network.state_dict().items() if not torch.equal(value, before[name])}
    assert {name.partition(".")[0] for name in changed} <= reached  # running means of batch normalization


def test_third_stage_begins_with_the_static_encoder(pairs: Path) -> None:
    """It is copied once: an epoch later the dynamic encoder has its own weights."""
    task = DslrTask(training())
    nn.init.ones_(task.network.static_encoder.layers[0].weight)
    task.start_epoch(2)
    assert bool((task.network.dynamic_encoder.layers[0].weight == 1).all())
    nn.init.zeros_(task.network.dynamic_encoder.layers[0].weight)
    task.start_epoch(3)
    assert not task.network.dynamic_encoder.layers[0].weight.any()


def test_slam_loss_reaches_the_dynamic_encoder_and_is_zero_for_the_truth(
    pairs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its gradient reaches it; a correct translation costs nothing."""
    torch.manual_seed(0)
    task = DslrTask(training())
    scans = open_scans(pairs)
    window = [scans[i] for i in range(8)]
    task.start_epoch(2)
    _, slam = task.losses(window)
    assert slam is not None
    value = slam()
    value.backward()
    assert value.item() > 0
    assert gradients(task) == {"dynamic_encoder"}
    truth = RangeReader(SENSOR).read(window, static=True).images
    monkeypatch.setattr(task.network.decoder, "forward", lambda codes: truth)
    _, slam = task.losses(window)
    assert slam is not None
    assert slam().item() < 1e-20


@pytest.mark.long
def test_learns_and_survives_being_stopped(pairs: Path, tmp_path: Path) -> None:
    """The loss falls to less than half; stopped in its third stage and resumed, it writes the same weights.

    These can be loaded, measured and drawn, and translate a scan of points.
    """
    settings = training(
        autoencoder_epochs=13, discriminator_epochs=1, epochs=22, batch=1, slam=ScheduleSettings(gamma=1.0, every=10)
    )
    scans = open_scans(pairs)
    task = train_task(new_task("dslr", settings), scans, tmp_path / "whole")
    log = read_log(tmp_path / "whole")
    assert log[51]["task_loss"] < 0.5 * log[0]["task_loss"]
    assert [row["step"] for row in log if row.get("slam_loss") is not None] == [76, 77, 78, 79]
    train_task(new_task("dslr", settings), scans, tmp_path / "parts", until=18)
    train_task(new_task("dslr", settings), scans, tmp_path / "parts")
    weights = (tmp_path / "whole" / WEIGHTS, tmp_path / "parts" / WEIGHTS)
    (whole, _), (parts, _) = (read_tensors(path) for path in weights)
    assert all(torch.equal(value, parts[name]) for name, value in whole.items())

    figures = measure(task, scans)
    assert figures.keys() == {
        "chamfer_m", "chamfer", "moved_m", "input_chamfer_m", "input_chamfer", "input_moved_m", "varies_m",
        "target_varies_m",
    }  # fmt: skip
    assert figures["moved_m"] < figures["input_moved_m"]  # the car is removed
    twins = torch.stack([RangeReader(SENSOR).read([scans[i]], static=True).images[0, 0] for i in range(len(scans))])
    assert figures["target_varies_m"] == pytest.approx(float(twins.std(0, correction=0).mean()) * 60.0, rel=1e-5)
    assert 0 < figures["varies_m"] < 2 * figures["target_varies_m"]
    draw(task, scans, 3, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
    network = load(weights[0])
    points = network.static_points(scans[3].points)
    assert points.shape[1] == 3
    assert bool(points.isfinite().all())
    with torch.no_grad():
        torch.testing.assert_close(points, task.clouds(scans[3])["output"], atol=0.5, rtol=0)  # projected again


def test_still_points_are_those_that_the_static_scan_has_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wall at 20 m is predicted: it is kept, a car at 8 m in front of it is not; points outside the image are
    kept."""
    network = Dslr(NETWORK)
    static = torch.full((1, 2, 16, 64), 20.0 / SENSOR.scale)
    monkeypatch.setattr(network, "forward", lambda images: static)
    points = torch.tensor([[20.0, 1, -1, 0], [8.0, 0, -1, 0], [16.0, 3, -1, 0], [30.0, 0, -1, 0], [8.0, 0, 5, 0]])
    assert network.still(points).tolist() == [True, False, True, True, True]


def test_a_scan_without_points_in_the_image_is_none_and_spoils_nothing() -> None:
    """Next to a truck nothing may be left: the losses stay finite, and figures are means over the other scans."""
    generator = torch.Generator().manual_seed(0)
    full = torch.rand(4000, 4, generator=generator) * torch.tensor([40.0, 40, 3, 1]) - torch.tensor([20.0, 20, 3, 0])
    near = torch.rand(100, 4, generator=generator)
    scans = [TaskScan(near if i == 1 else full, None, full, "00", i) for i in range(4)]
    task = DslrTask(training())
    for epoch in range(3):
        task.start_epoch(epoch)
        loss, slam = task.losses(scans)
        assert loss.isfinite()
        if slam is not None:
            assert slam().isfinite()
    rows = [measure(task, TaskScans([[scan]])) for scan in scans]
    assert math.isnan(rows[1]["chamfer_m"])
    found = measure(task, TaskScans([scans]))
    assert found["chamfer_m"] == pytest.approx(sum(row["chamfer_m"] for row in rows if row is not rows[1]) / 3)


def test_the_authors_weights(pairs: Path) -> None:
    """Stage 1 uses both kinds of scans; in stage 3 the cross entropy has weight 10, over the scans of a step."""
    scans = open_scans(pairs)
    window = [scans[i] for i in range(4)]
    losses = {}
    for shared in (False, True):
        torch.manual_seed(0)
        task = DslrTask(training(network=NETWORK, adversarial=10.0, adversarial_shared=shared, static_only=not shared))
        task.start_epoch(0)
        torch.manual_seed(1)
        first = float(task.losses(window)[0].detach())
        task.start_epoch(task.settings.third)
        torch.manual_seed(1)
        losses[shared] = first, float(task.losses(window)[0].detach())
    torch.manual_seed(0)
    plain = DslrTask(training(network=NETWORK, adversarial=0.0))
    plain.start_epoch(plain.settings.third)
    torch.manual_seed(1)
    bare = float(plain.losses(window)[0].detach())
    assert losses[True][0] != losses[False][0]
    assert losses[True][1] - bare == pytest.approx((losses[False][1] - bare) / 4, rel=0.02)
