# SPDX-License-Identifier: Apache-2.0
"""Small versions of CARLA-64 and ARD-16: the names and shapes of DSLR's arrays, and errors of other arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dpm2_core.errors import UsageError
from dpm2_core.network.perception.range_image import RangeImageSettings, to_points
from dpm2_core.tasks.open import open_scans
from dpm2_core.tasks.pairs import SCALE, ImageScan, open_pairs
from dpm2_core.tasks.range_scans import RangeReader


def images(scans: int, rows: int = 64, columns: int = 512, seed: int = 0) -> np.ndarray:
    """(scans, 2, rows, columns): d of 5 to 65 m and z of -2 to 2 m, in units of 120 m."""
    rng = np.random.default_rng(seed)
    d, z = rng.uniform(5, 65, (scans, rows, columns)), rng.uniform(-2, 2, (scans, rows, columns))
    return (np.stack([d, z], 1) / SCALE).astype(np.float32)


def carla64(folder: Path, prefix: str = "") -> None:
    """Two pairs, of 3 and 2 scans, named as in the processed data set."""
    folder.mkdir(exist_ok=True)
    for k, scans in ((0, 3), (8, 2)):
        np.save(folder / f"{prefix}s{k}.npy", images(scans, seed=k))
        np.save(folder / f"{prefix}d{k}.npy", images(scans, seed=k + 1))


@pytest.mark.parametrize("prefix", ["", "test"])
def test_carla64_is_read_as_pairs_of_range_images(tmp_path: Path, prefix: str) -> None:
    """An array is a sequence; points are those of the image, and tasks receive the rows and columns that they
    request."""
    carla64(tmp_path, prefix)
    scans = open_scans(tmp_path, needs=["static"])
    assert scans.lengths == [3, 2]
    scan = scans[4]
    assert isinstance(scan, ImageScan)
    assert (scan.sequence.rpartition("/")[2], scan.number) == (f"{prefix}d8", 1)
    true = torch.from_numpy(np.load(tmp_path / f"{prefix}s8.npy")[1])
    assert scan.static is not None
    torch.testing.assert_close(scan.static[:, :3], to_points(true, SCALE))
    settings = RangeImageSettings(first=0, rows=40, columns=256)
    read = RangeReader(settings).read([scan], static=True)
    torch.testing.assert_close(read.images[0], true[:, :40, ::2])
    assert read.masks.all()


def test_ard16_as_points_in_slots(tmp_path: Path) -> None:
    """(N, 16, 512, 4) in two folders: empty slots are marked, and filled for the network."""
    values = images(2, rows=16)
    angle = (np.arange(512) + 0.5) * (2 * np.pi / 512)
    d, z = values[:, 0] * SCALE, values[:, 1] * SCALE
    xyz = np.stack([d * np.cos(angle), d * np.sin(angle), z, 0 * z], -1)
    xyz[:, 3, 100:110] = 0
    for name in ("static_out_npy", "dynamic_out_npy"):
        (tmp_path / name).mkdir()
        np.save(tmp_path / name / "0.npy", xyz)
    scan = open_scans(tmp_path)[1]
    assert isinstance(scan, ImageScan)
    low, high = np.percentile(xyz[..., :3].reshape(-1, 3), [1, 99], axis=0)
    usual = ((xyz[1][..., :3] >= low) & (xyz[1][..., :3] <= high)).all(-1)  # the authors remove outliers in this way
    usual[3, 100:110] = False
    assert 0.92 < usual.mean() < 0.97
    np.testing.assert_array_equal(scan.mask.numpy(), usual)
    assert len(scan.points) == usual.sum()
    assert (scan.image[0] > 0).all()
    settings = RangeImageSettings(beams=((15.0, -15.0, 16),), first=0, rows=16, columns=512, scale=60.0)
    read = RangeReader(settings).read([scan])
    near = scan.mask.numpy() & (d[1] < 60)  # points beyond the scale count as empty, and are filled
    np.testing.assert_array_equal(read.masks[0].numpy(), near)
    assert 0 < float(read.images[0, 0].min()) <= float(read.images[0, 0].max()) < 1
    np.testing.assert_allclose(read.images[0, 0].numpy()[near] * 60.0, d[1][near], rtol=1e-5)
    result = read.clouds()[0]  # with the columns' own azimuths, the points do not move
    np.testing.assert_allclose(result.numpy(), xyz[1][near][:, :3], atol=1e-3)


def in_slots(scans: int = 2, columns: int = 512) -> np.ndarray:
    """(scans, 16, columns, 3) x, y, z, m, from straight ahead to the left; a sector is empty."""
    d, z = np.moveaxis(SCALE * images(scans, rows=16, columns=columns).astype(np.float64), 1, 0)
    angle = (np.arange(columns) + 0.5) * (2 * np.pi / columns)
    xyz = np.stack([d * np.cos(angle), d * np.sin(angle), z], -1)
    xyz[:, :, 100:150] = 0
    return xyz


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("start", [0, 7, 256])
def test_points_in_slots_stay_where_they_are_in_whatever_order_the_columns_come(
    tmp_path: Path, start: int, mirrored: bool
) -> None:
    """Arrays that begin at another azimuth, or go to the right, give the same points; previously, these were rotated or
    mirrored."""
    plain = in_slots()
    other = np.roll(plain[:, :, ::-1] if mirrored else plain, start, axis=2)
    for name, xyz in (("plain", plain), ("other", other)):
        (tmp_path / name).mkdir()
        for twin in ("s0.npy", "d0.npy"):
            np.save(tmp_path / name / twin, xyz)
    expected, found = (open_scans(tmp_path / name)[1] for name in ("plain", "other"))
    assert isinstance(expected, ImageScan)
    assert isinstance(found, ImageScan)
    for name in ("points", "static", "image", "mask", "static_image", "static_mask"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name))
    np.testing.assert_allclose(found.points[:, :3], plain[1][found.mask.numpy()], atol=1e-3)


def test_columns_that_do_not_go_around_evenly_are_named(tmp_path: Path) -> None:
    """Shuffled, or from a sector: no shift matches the points to the columns. Without any points there is no error."""
    plain = in_slots()
    shuffled = plain[:, :, np.random.default_rng(0).permutation(512)]
    for xyz in (shuffled, plain[:, :, :100]):
        for twin in ("s0.npy", "d0.npy"):
            np.save(tmp_path / twin, xyz)
        with pytest.raises(
            UsageError, match=r"d0\.npy: its columns, or those of its twin, are not at equal steps of azimuth"
        ):
            open_scans(tmp_path)
    for twin in ("s0.npy", "d0.npy"):
        np.save(tmp_path / twin, 0 * plain)
    assert not len(open_scans(tmp_path)[0].points)


def test_pairs_by_number_and_their_poses(tmp_path: Path) -> None:
    """Numbers select pairs, with or without leading zeros; poses next to them have one per scan, or are an error."""
    carla64(tmp_path)
    assert open_scans(tmp_path, sequences=["08"]).lengths == [2]
    with pytest.raises(UsageError, match="no sequence 3; there are 0, 8"):
        open_scans(tmp_path, sequences=["8", "3"])
    first, last = open_pairs(tmp_path)
    assert first.poses is None
    (tmp_path / "poses8.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 2 0 1 0 0 0 0 1 0\n")
    assert last.poses is not None
    assert last.poses[1, 0, 3] == 2
    (tmp_path / "poses0.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(UsageError, match=r"poses0\.txt: 1 poses for 3 scans"):
        assert first.poses is None


def test_the_digest_shows_a_change_of_any_scan(tmp_path: Path) -> None:
    """Here of the last scan of the last pair. Previously only the first scan of a pair counted."""
    carla64(tmp_path)
    before = open_scans(tmp_path).digest()
    for name in ("s8", "d8"):
        array = np.load(tmp_path / f"{name}.npy")
        array[-1] *= 0.5
        np.save(tmp_path / f"{name}.npy", array)
        assert open_scans(tmp_path).digest() != before
        before = open_scans(tmp_path).digest()


def test_damage_is_named(tmp_path: Path) -> None:
    """A missing twin, twins of different shapes, a pickle, another shape, NaN, and rows that do not exist."""
    carla64(tmp_path / "a")
    (tmp_path / "a" / "s8.npy").unlink()
    with pytest.raises(UsageError, match=r"d8.npy: no static twin"):
        open_scans(tmp_path / "a")
    np.save(tmp_path / "a" / "s8.npy", images(1))
    with pytest.raises(UsageError, match=r"d8.npy: shape \(2, 2, 64, 512\), its static twin s8.npy has \(1, 2"):
        open_scans(tmp_path / "a")
    np.save(tmp_path / "a" / "s8.npy", np.array([{"code": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(UsageError, match=r"s8.npy: no array of numbers"):
        open_scans(tmp_path / "a")
    np.save(tmp_path / "a" / "s8.npy", np.zeros((4, 5), np.float32))
    with pytest.raises(UsageError, match=r"s8.npy: shape \(4, 5\) float32; want"):
        open_scans(tmp_path / "a")
    (tmp_path / "a" / "s8.npy").write_bytes(b"nothing")
    with pytest.raises(UsageError, match=r"s8.npy: no array of numbers"):
        open_scans(tmp_path / "a")
    bad = images(2)
    bad[1, 0, 3, 3] = np.nan
    carla64(tmp_path / "b")
    np.save(tmp_path / "b" / "d8.npy", bad)
    scans = open_scans(tmp_path / "b")
    with pytest.raises(UsageError, match=r"d8.npy: scan 1 .* not finite"):
        scans[4]
    with pytest.raises(UsageError, match=r"no rows 50 to 89"):
        RangeReader(RangeImageSettings(first=50)).read([scans[0]])
