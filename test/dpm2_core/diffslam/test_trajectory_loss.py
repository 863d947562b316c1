# SPDX-License-Identifier: Apache-2.0
"""The SLAM loss: zero for equal clouds, correct gradients, selections, truncation, graphs, the cache and bad input."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from torch import Tensor

from dpm2_core.diffslam import SlamLoss, SlamLossSettings, odometry, trajectory_loss
from dpm2_core.diffslam.icp import IcpSettings
from dpm2_core.diffslam.soft_lm import SoftLmSettings
from dpm2_core.errors import UsageError
from dpm2_core.geometry import se3

CONVERGED = SlamLossSettings(icp=IcpSettings(solver=SoftLmSettings(iterations=30)))


def leaves(clouds: list[Tensor]) -> list[Tensor]:
    return [cloud.clone().requires_grad_() for cloud in clouds]


def test_odometry_follows_the_scans(scans: list[Tensor], motion: Tensor) -> None:
    """Each pose is correct to 1 mm, from identity and from a guess, for a list and for a padded tensor with its
    mask."""
    requested = torch.stack([torch.linalg.matrix_power(motion, t) for t in range(4)])
    padded = torch.nn.functional.pad(torch.stack(scans), (0, 0, 0, 50), value=torch.nan)
    mask = torch.nn.functional.pad(torch.ones(4, 600), (0, 50))
    for found in (odometry(scans), odometry(scans, guess=motion), odometry(padded, mask)):
        torch.testing.assert_close(found, requested, atol=1e-3, rtol=0)


@pytest.mark.parametrize("gradient", ["unrolled", "implicit"])
def test_equal_clouds_have_no_loss_and_no_gradient(noisy: list[Tensor], gradient: str) -> None:
    """Both are exactly zero, also if a graph is relaxed."""
    icp = IcpSettings(solver=SoftLmSettings(gradient=gradient))
    for spans in ((1,), (1, 2)):
        pred = leaves(noisy)
        loss = SlamLoss(SlamLossSettings(icp=icp, spans=spans))(pred, noisy)
        loss.backward()
        # The attached Newton step rounds differently with a graph: 1e-14 m at most, and its square.
        assert float(loss.detach()) < 1e-20
        assert max(float(cloud.grad.abs().max()) for cloud in pred) < 1e-12  # type: ignore[union-attr]


@pytest.mark.slow
@pytest.mark.parametrize("gradient", ["unrolled", "implicit"])
def test_slope_by_one_point_is_the_finite_difference(noisy: list[Tensor], scans: list[Tensor], gradient: str) -> None:
    """Within 1 %, for the points with the largest gradient. One is in the last scan, a source; one is in a scan that is
    also a target, whose normals rotate with it. Points are moved by 0.1 mm along the gradient."""
    loss = SlamLoss(SlamLossSettings(icp=IcpSettings(solver=SoftLmSettings(iterations=30, gradient=gradient))))
    pred = leaves(noisy)
    slopes = torch.autograd.grad(loss(pred, scans), pred)
    for t in (1, 3):
        i = int(slopes[t].norm(dim=1).argmax())
        length = float(slopes[t][i].norm())

        def at(step: float, t: int = t, i: int = i, direction: Tensor = slopes[t][i] / length) -> float:
            moved = [scan.clone() for scan in noisy]
            moved[t][i] += step * direction
            with torch.no_grad():
                return float(loss(moved, scans))

        assert (at(1e-4) - at(-1e-4)) / 2e-4 == pytest.approx(length, rel=0.01)


def test_descending_the_loss_repairs_a_cloud(noisy: list[Tensor], scans: list[Tensor]) -> None:
    """A scan that was shifted as a whole by 5 cm is moved back: the gradient has the right direction."""
    shift = torch.tensor([0.05, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    loss = SlamLoss()
    before = loss([scans[0], scans[1] + shift, *scans[2:]], scans)
    (slope,) = torch.autograd.grad(before, shift)
    step = 0.02 * slope / slope.norm()
    assert float(slope[0]) > 0
    assert float(loss([scans[0], scans[1] + shift.detach() - step, *scans[2:]], scans)) < float(before.detach())


def test_warm_start_measures_at_the_end_of_the_way(scans: list[Tensor], noisy: list[Tensor]) -> None:
    """Two iterations from the identity are too few for a step of 0.8 m, and neither branch converges. Started where the
    reference ended, the loss is close to the converged one. Equal clouds have no loss; the reference is cached."""
    two = IcpSettings(solver=SoftLmSettings(iterations=2))
    with torch.no_grad():
        requested = float(SlamLoss(CONVERGED)(noisy, scans))
        cold = float(SlamLoss(SlamLossSettings(icp=two))(noisy, scans))
        loss = SlamLoss(SlamLossSettings(icp=two, warm_start=True))
        warm = float(loss(noisy, scans))
        assert abs(warm - requested) < 0.5 * abs(cold - requested)
        assert float(loss(noisy, noisy)) < 1e-20
        frames = [("drive", t) for t in range(4)]
        assert float(loss(noisy, scans, frames=frames)) == warm
        assert float(loss(noisy, noisy, frames=frames)) == warm  # with the frames' own targets, not these


def test_removing_a_moving_object_reduces_the_loss(scans: list[Tensor]) -> None:
    """A fifth of the points moves with the sensor; the loss decreases with their weight, and its gradient shows
    that."""
    generator = torch.Generator().manual_seed(5)
    box = torch.rand(150, 3, generator=generator, dtype=torch.float64) * torch.tensor([4, 2, 1.5]) + torch.tensor(
        [8.0, 3.0, -1.6]
    )
    pred = [torch.cat([scan, box]) for scan in scans]
    loss, values = SlamLoss(), []
    for level in (1.0, 0.3, 0.0):
        weight = torch.full((150,), level, dtype=torch.float64, requires_grad=True)
        value = loss(pred, scans, [torch.cat([torch.ones(600).double(), weight])] * 4)
        values.append(float(value.detach()))
        if level:
            assert float(torch.autograd.grad(value, weight)[0].sum()) > 0
    assert values[0] > values[1] > values[2]
    assert values[2] < 1e-4 * values[0]


def test_float32_clouds_get_float32_gradients(noisy: list[Tensor], scans: list[Tensor]) -> None:
    """Networks predict float32; the solver itself uses double."""
    pred = leaves([cloud.float() for cloud in noisy])
    loss = SlamLoss()(pred, [scan.float() for scan in scans])
    assert loss.dtype == torch.float64
    loss.backward()
    assert all(cloud.grad is not None and cloud.grad.dtype == torch.float32 for cloud in pred)


def test_truncation_stops_the_gradient_and_not_the_value(noisy: list[Tensor], scans: list[Tensor]) -> None:
    """With truncate = 1 the last pose depends on the last pair alone."""
    whole = odometry(leaves(noisy))
    pred = leaves(noisy)
    cut = odometry(pred, settings=SlamLossSettings(truncate=1))
    torch.testing.assert_close(cut, whole)
    slopes = torch.autograd.grad(cut[3, :3, 3].sum(), pred)
    assert float(slopes[1].abs().max()) == 0.0
    assert float(slopes[2].abs().max()) > 0


def test_spans_make_a_graph_that_averages_noise(noisy: list[Tensor], motion: Tensor) -> None:
    """Scans two apart add measurements: the trajectory stays correct, and differs from that of the chain alone."""
    requested = torch.stack([torch.linalg.matrix_power(motion, t) for t in range(4)])
    chain = odometry(noisy, settings=CONVERGED)
    graph = odometry(noisy, settings=CONVERGED.model_copy(update={"spans": (1, 2)}))
    assert float((graph - chain).abs().max()) > 1e-6
    torch.testing.assert_close(graph, requested, atol=0.02, rtol=0)  # noise of 1 cm on 600 points, three steps


def test_a_scan_that_shows_nothing_does_not_move_the_others(scans: list[Tensor], motion: Tensor) -> None:
    """Its pairs have no effect; the pair around it connects the trajectory. It stays at the pose of its guess."""
    requested = torch.stack([torch.linalg.matrix_power(motion, t) for t in range(4)])
    weights = [torch.ones(len(scan)).double() for scan in scans]
    weights[2] = torch.zeros(len(scans[2])).double()
    found = odometry(scans, weights, settings=CONVERGED.model_copy(update={"spans": (1, 2)}))
    torch.testing.assert_close(found[[0, 1, 3]], requested[[0, 1, 3]], atol=2e-3, rtol=0)
    torch.testing.assert_close(found[2], found[1], atol=2e-3, rtol=0)


def test_scans_far_apart_are_registered_from_where_the_steps_have_led(scans: list[Tensor], motion: Tensor) -> None:
    """Three steps of 0.8 m are too far for two iterations from the identity."""
    requested = torch.stack([torch.linalg.matrix_power(motion, t) for t in range(4)])
    graph = odometry(scans, settings=SlamLossSettings(spans=(1, 3)))
    chain = odometry(scans)
    torch.testing.assert_close(graph, requested, atol=max(2e-3, 2 * float((chain - requested).abs().max())), rtol=0)
    assert torch.equal(odometry(scans, settings=SlamLossSettings(spans=(1, 10))), chain)  # no scans are that far apart


@pytest.mark.parametrize("settings", [{"spans": (1, 2), "truncate": 2}, {"spans": (0,)}, {"spans": ()}])
def test_spans_that_make_no_sense_are_rejected(settings: dict) -> None:
    with pytest.raises(ValidationError):
        SlamLossSettings(**settings)


def test_reference_is_kept_by_frame(noisy: list[Tensor], scans: list[Tensor]) -> None:
    """With named frames, the second call does not read the targets; without names it does."""
    loss, frames = SlamLoss(), [("00", t) for t in range(4)]
    first = loss(noisy, scans, frames=frames)
    other = [scan + 0.5 * t for t, scan in enumerate(scans)]
    assert float(loss(noisy, other, frames=frames)) == float(first)
    assert float(loss(noisy, other)) != float(first)


def test_windows_that_are_not_contiguous_are_rejected(scans: list[Tensor]) -> None:
    """The border of two sequences, a gap, the wrong order, too few names."""
    loss = SlamLoss()
    for frames, message in (
        ([("00", 8), ("00", 9), ("01", 0), ("01", 1)], "border of sequences 00 and 01"),
        ([("00", 1), ("00", 2), ("00", 4), ("00", 5)], "not contiguous"),
        ([("00", 4), ("00", 3), ("00", 2), ("00", 1)], "not contiguous"),
        ([("00", 4), ("00", 4), ("00", 4), ("00", 4)], "not contiguous"),
        ([("00", 1)], "1 frames are named for 4"),
    ):
        with pytest.raises(UsageError, match=message):
            loss(scans, scans, frames=frames)
    loss(scans, scans, frames=[("00", 2 * t) for t in range(4)])  # every second scan is a window


@pytest.mark.parametrize("side", ["predicted", "target"])
def test_unusable_clouds_are_named(scans: list[Tensor], side: str) -> None:
    """The error names the side, the scan and the problem."""

    def rejected(clouds: list[Tensor], message: str) -> None:
        with pytest.raises(UsageError, match=f"{side}.*{message}"):
            SlamLoss()(*((clouds, scans) if side == "predicted" else (scans, clouds)))

    broken = scans[2].clone()
    broken[3, 1] = torch.nan
    rejected([*scans[:2], broken, scans[3]], "scan 2: 1 of its 600 points are not finite")
    rejected([*scans[:3], scans[3][:49]], "scan 3: 49 points; want at least 50")
    rejected([*scans[:3], scans[3][:, :2]], r"scan 3: want floating-point points \(N, 3\)")
    rejected([*scans[:3], scans[3].long()], "scan 3: want floating-point")


def test_unusable_weights_and_windows_are_rejected(scans: list[Tensor]) -> None:
    """Negative, above one, NaN, of another length; windows of different or too few scans; a guess of another shape."""
    for value in (-0.1, 1.1, float("nan")):
        with pytest.raises(UsageError, match=r"scan 0: 600 of its 600 weights are not in 0\.\.1"):
            SlamLoss()(scans, scans, [torch.full((600,), value)] * 4)
    with pytest.raises(UsageError, match=r"scan 0: weights \(7,\) for 600 points"):
        SlamLoss()(scans, scans, [torch.ones(7)] * 4)
    with pytest.raises(UsageError, match="weights of 1 scans"):
        SlamLoss()(scans, scans, [torch.ones(600)])
    with pytest.raises(UsageError, match="3 predicted scans for 4"):
        SlamLoss()(scans[:3], scans)
    with pytest.raises(UsageError, match="window of 1 scans"):
        SlamLoss()(scans[:1], scans[:1])
    with pytest.raises(UsageError, match="guess"):
        SlamLoss()(scans, scans, guess=torch.eye(3))


def test_zero_weights_give_a_finite_loss_and_no_gradient(noisy: list[Tensor], motion: Tensor) -> None:
    """The predicted scans keep the guessed pose; nothing becomes NaN."""
    weights = [torch.zeros(600, dtype=torch.float64, requires_grad=True) for _ in noisy]
    pred = leaves(noisy)
    loss = SlamLoss()(pred, noisy, weights)
    steps = np.stack([se3.log(np.linalg.matrix_power(motion.numpy(), t)) for t in (1, 2, 3)])
    travelled = np.stack([np.linalg.matrix_power(motion.numpy(), t)[:3, 3] for t in (1, 2, 3)])
    requested = ((travelled**2).sum(1) + 25 * (steps[:, :3] ** 2).sum(1)).mean()
    assert float(loss.detach()) == pytest.approx(requested, rel=0.02)  # the reference is that of noisy scans
    loss.backward()
    assert all(float(x.grad.abs().max()) == 0.0 for x in (*pred, *weights))  # type: ignore[union-attr]


def test_large_clouds_are_downsampled_alike(noise: np.random.Generator, scans: list[Tensor]) -> None:
    """More than `points` are downsampled, in the same way in each call; gradients go to the points that were kept."""
    big = [torch.cat([scan, scan + 0.01, scan - 0.01]) for scan in scans]
    pred = leaves(big)
    loss = SlamLoss(SlamLossSettings(points=500))(pred, big)
    assert float(loss.detach()) == 0.0
    loss = SlamLoss(SlamLossSettings(points=500))(pred, scans)
    slopes = torch.autograd.grad(loss, pred)
    assert all(0 < int((slope.abs().sum(1) > 0).sum()) <= 500 for slope in slopes)


def test_a_weight_of_zero_changes_the_choice_of_that_point_alone(scans: list[Tensor]) -> None:
    """Predicted and target scans with more points than are kept keep the same ones, if their weights differ little."""
    big = [torch.cat([scan, scan + 0.01, scan - 0.01]) for scan in scans]
    weights = [torch.ones(len(scan)) for scan in big]
    for weight in weights:
        weight[7] = 0
    loss = SlamLoss(SlamLossSettings(points=500))(big, big, weights)
    # One of 500 points in a voxel of 0.5 m; drawn independently, the loss of these scans is 100 times as large.
    assert float(loss) < 1e-6


def test_trajectory_loss_by_hand() -> None:
    """Eq. 3: one pose 3 m off, one 0.1 rad; no gradient into the reference; shapes are checked."""
    reference = torch.eye(4).double().repeat(3, 1, 1).requires_grad_()
    poses = torch.eye(4).double().repeat(3, 1, 1)
    poses[1, 0, 3] = 3.0
    poses[2] = torch.from_numpy(se3.exp(np.array([0, 0, 0.1, 0, 0, 0])))
    value = trajectory_loss(poses.requires_grad_(), reference, rotation_weight=25.0)
    assert float(value.detach()) == pytest.approx((9.0 + 25 * 0.01) / 2)
    value.backward()
    assert reference.grad is None
    with pytest.raises(UsageError, match="trajectory loss"):
        trajectory_loss(poses, poses[:2])
    with pytest.raises(UsageError, match="trajectory loss"):
        trajectory_loss(poses[:1], poses[:1])
    elsewhere = torch.from_numpy(se3.exp(np.array([0, 0, 1, 100, 0, 0]))) @ poses
    with pytest.raises(UsageError, match="the first poses differ"):  # as poses of a drive that are not made relative
        trajectory_loss(poses, elsewhere)
    assert float(trajectory_loss(elsewhere, elsewhere).detach()) < 1e-12


def test_clouds_that_are_no_tensors_are_named(scans: list[Tensor]) -> None:
    """Arrays, as a frame has them. Previously an AttributeError of numpy."""
    with pytest.raises(UsageError, match="predicted clouds, scan 0: want tensors of torch, found ndarray"):
        SlamLoss()([scan.numpy() for scan in scans], scans)  # type: ignore[misc]
    with pytest.raises(UsageError, match="scans, scan 0: want tensors of torch, found ndarray"):
        odometry(scans, [np.ones(len(scan)) for scan in scans])  # type: ignore[misc]


def test_a_placebo_compares_with_the_window_before(scans: list[Tensor]) -> None:
    """The first window has no previous window and no loss, for any prediction. The next, which moves in the opposite
    direction, is compared with the first. After a restart the same holds again."""
    loss = SlamLoss(SlamLossSettings(placebo=True, icp=CONVERGED.icp))
    assert float(loss(scans[::-1], scans)) == 0
    backwards = scans[::-1]
    requested = trajectory_loss(odometry(backwards, settings=CONVERGED), odometry(scans, settings=CONVERGED))
    assert float(loss(backwards, backwards)) == pytest.approx(float(requested), rel=1e-6)
    assert float(requested) > 1
    loss.restart()
    assert float(loss(scans[::-1], scans)) == 0
