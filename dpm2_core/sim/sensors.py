# SPDX-License-Identifier: Apache-2.0
"""Random sensors for training worlds: no two of them are alike."""

from __future__ import annotations

import numpy as np

from dpm2_core.sim.settings import HDL64E, Imperfections, LidarConfig

_SCALED_ERRORS = ("uneven", "angle_bias", "range_bias", "growth", "footprint", "skew")


def real_sensor(clean: LidarConfig) -> LidarConfig:
    """A LiDAR with the errors of the HDL-64E; the origins of its beams only if it has 64 spinning beams."""
    own_origins = clean.beams == 64 and clean.pattern == "spinning"
    real = HDL64E.real if own_origins else HDL64E.real.model_copy(update={"emitters": (0.0, 0.0)})
    return clean.model_copy(update={"noise": HDL64E.noise, "dropout": HDL64E.dropout, "real": real})


def drawn_sensor(usual: LidarConfig, real: float, others: float, rng: np.random.Generator) -> LidarConfig:
    """A world's LiDAR: with probability `others` not the usual one, with probability `real` with real errors."""
    config = _random_sensor(usual, rng) if rng.random() < others else usual
    if rng.random() >= real:
        return config
    noise, dropout = HDL64E.noise * _random_factor(rng), HDL64E.dropout * _random_factor(rng)
    return config.model_copy(update={"noise": noise, "dropout": dropout, "real": _random_errors(config, rng)})


def _random_sensor(usual: LidarConfig, rng: np.random.Generator) -> LidarConfig:
    """16 to 128 beams or a rosette, 0.4 to 3 m high, one in three tilted by up to 20 deg."""
    beams, columns = [(16, 1810), (32, 1810), (64, 1448), (128, 1024), (16, 1500)][kind := int(rng.integers(5))]
    height = float(np.exp(rng.uniform(np.log(0.4), np.log(3.0))))
    tilted = rng.random() < 0.33
    tilt = {"roll": float(rng.normal(0, 2)), "pitch": float(rng.uniform(-5, 20))} if tilted else {}
    return usual.model_copy(
        update={
            "pattern": "rosette" if kind == 4 else "spinning", "beams": beams, "columns": columns, "height": height,
            "car_body": height > 1.6, "min_range": 0.4, "range": float(rng.choice([60.0, 80.0, 120.0])), **tilt,
        }
    )  # fmt: skip


def _random_errors(config: LidarConfig, rng: np.random.Generator) -> Imperfections:
    """Errors of the HDL-64E, half to twice as large; one in six in rain or dust, one in six behind a dirty window."""
    usual = real_sensor(config).real
    changes = {name: getattr(usual, name) * _random_factor(rng) for name in _SCALED_ERRORS}
    changes |= {
        "serial": int(rng.integers(2**31)),
        "weak": float(rng.uniform(0, 3)), "sway": float(rng.uniform(0.4, 3)), "glare": float(rng.uniform(0, 0.5)),
        "drops": float(rng.uniform(0.001, 0.02)) * bool(rng.random() < 1 / 6),
        "dirt": float(rng.uniform(0.02, 0.2)) * bool(rng.random() < 1 / 6),
    }  # fmt: skip
    return usual.model_copy(update=changes)


def _random_factor(rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(-np.log(2), np.log(2))))
