# SPDX-License-Identifier: Apache-2.0
"""The comparison with and without the SLAM loss: its arithmetic, and that it goes on where it was stopped."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import tasks
from benchmarks.harness import Options
from dpm2_core.errors import UsageError
from dpm2_core.tasks.drives import TaskDriveSettings


def test_summary_by_hand() -> None:
    """Gain is positive where the SLAM loss helps, whichever way is better; the spread is that of both arms together."""
    runs = {
        "without": {str(i): {"mse": mse, "recall": recall} for i, (mse, recall) in enumerate([(1, 0.8), (2, 0.8)])},
        "with": {str(i): {"mse": mse, "recall": recall} for i, (mse, recall) in enumerate([(0.7, 0.6), (1.7, 0.6)])},
    }
    found = tasks.summary(runs, {"mse": "lower", "recall": "higher"})
    assert found["mse"]["without"] == {"mean": 1.5, "std": pytest.approx(0.7071, abs=1e-4)}
    assert found["mse"]["gain"] == pytest.approx(0.2)
    assert found["mse"]["beyond_spread"] is False
    # Each seed is better by 0.3 of 1.5: what the seeds differ by does not hide it.
    assert found["mse"]["paired"] == {
        "mean": pytest.approx(0.2), "standard_error": pytest.approx(0, abs=1e-9), "better": 2, "seeds": 2
    }  # fmt: skip
    assert found["recall"]["paired"]["better"] == 0
    assert found["recall"]["gain"] == pytest.approx(-0.25)
    assert found["recall"]["beyond_spread"] is True
    one = tasks.summary({"without": {"0": {"mse": 1.0}}, "with": {}}, {"mse": "lower"})
    assert one == {"mse": {"without": {"mean": 1.0, "std": None}}}


@pytest.mark.slow
def test_comparison_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A training that ended is not repeated, one of other settings is; the file keeps the other tasks' parts."""
    drives = TaskDriveSettings.model_validate(
        {"train": 1, "train_frames": 3, "val": 1, "val_frames": 2, "lidar": {"columns": 48, "beams": 16}}
    )
    small = (
        "network.cells=32", "network.cell=2", "network.channels=4", "epochs=2", "window=3", "every=1", "slam.gamma=0.1",
        "slam.every=2", "slam_loss.points=200",
    )  # fmt: skip
    figures = tasks.COMPARISONS["gndnet"].figures
    monkeypatch.setattr(tasks, "COMPARISONS", {"gndnet": tasks.Comparison(small, figures, drives)})
    trained = []
    original = tasks.train_task
    monkeypatch.setattr(
        tasks, "train_task", lambda *a, **k: trained.append(a[0].settings.slam.gamma) or original(*a, **k)
    )
    options = Options(threads=1, repetitions=1, only="gndnet", out=tmp_path / "out", cache=tmp_path / "cache")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "tasks.json").write_text('{"parts": {"dslr": {"summary": {}, "runs": {"with": {}}}}}')
    tasks.bench_tasks(options)
    assert trained == [0.0, 0.0, 0.1]  # the first epoch, which both share, and each arm from there
    record = json.loads((tmp_path / "out" / "tasks.json").read_text())
    assert record["parts"].keys() == {"dslr", "gndnet"}
    part = record["parts"]["gndnet"]
    assert part["complete"]
    run = part["runs"]["with"]["0"]
    assert run["slam_share_at_first"] > 0
    assert run["mse"] == pytest.approx(part["summary"]["mse"]["with"]["mean"])
    assert part["runs"]["without"]["0"]["slam_share_at_first"] is None
    tasks.bench_tasks(options)
    assert trained == [0.0, 0.0, 0.1]
    tasks.bench_tasks(Options(**{**vars(options), "overrides": ("slam.gamma=0.2",)}))
    assert trained == [0.0, 0.0, 0.1, 0.2]
    with pytest.raises(UsageError, match="--only nonsense: no such part"):
        tasks.bench_tasks(Options(only="nonsense"))


@pytest.mark.slow
def test_arms_share_their_first_epochs_and_slam_is_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What comes before the SLAM loss is trained once; odometry on the clouds of both arms is in the figures."""
    drives = TaskDriveSettings.model_validate(
        {
            "train": 1,
            "train_frames": 3,
            "val": 1,
            "val_frames": 3,
            "lidar": {"columns": 128, "beams": 16},
            "traffic": 20,
        }
    )
    small = (
        "network.image={beams: [[15, -15, 16]], first: 0, rows: 16, columns: 64}", "network.channels=4",
        "network.latent=8", "autoencoder_epochs=1", "discriminator_epochs=1", "epochs=4", "window=3", "every=1",
        "batch=1", "slam.gamma=0.1", "slam.every=4", "slam_loss.points=200",
    )  # fmt: skip
    comparison = tasks.Comparison(small, {"chamfer_m": "lower"}, drives, slam=True)
    monkeypatch.setattr(tasks, "COMPARISONS", {"dslr": comparison})
    trained = []
    original = tasks.train_task
    monkeypatch.setattr(
        tasks,
        "train_task",
        lambda *a, **k: trained.append((a[0].settings.slam.gamma, a[3], k["until"])) or original(*a, **k),
    )
    options = Options(threads=1, repetitions=1, only="dslr", out=tmp_path, cache=tmp_path / "cache")
    runs = tasks.bench_tasks(options).results["parts"]["dslr"]["runs"]
    assert trained == [(0.0, False, 3), (0.0, True, None), (0.1, True, None)]
    assert runs["with"]["0"].keys() >= {"chamfer_m", "output_ate_m", "input_rpe_m", "target_rpe_deg"}
    assert runs["with"]["0"]["slam_share_at_first"] > 0
    logs = [(tmp_path / "cache/tasks/dslr" / arm / "log.jsonl").read_text() for arm in ("with_0", "without_0")]
    first, second = ([json.loads(line)["task_loss"] for line in log.splitlines()][:3] for log in logs)
    assert first == second
