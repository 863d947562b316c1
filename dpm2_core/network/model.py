# SPDX-License-Identifier: Apache-2.0
"""Encoder and decoder as one model, which computes descriptors, poses and overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import nn

from dpm2_core.descriptors import Descriptors
from dpm2_core.estimates import Registration
from dpm2_core.frame import Array, Frame
from dpm2_core.geometry import se3
from dpm2_core.network.decoder import Decoder, Prepared
from dpm2_core.network.encoder import Encoder
from dpm2_core.network.matching import correspond, match_scores
from dpm2_core.network.pose_solver import Solver, agreement
from dpm2_core.network.precision import mixed_precision
from dpm2_core.network.registrations import register_batch
from dpm2_core.network.settings import NetworkSettings
from dpm2_core.network.tokens import Tokens, to_tokens

_MAX_PREPARED = 4  # prepared sets that are cached: a scan, the map before a pause and the one after it


class DeepPointMap2(nn.Module):
    """The whole network.

    Attributes:
        solver: method that computes a pose from pairs of descriptors.
    """

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        self.solver: Solver = "consensus"
        self.encoder = Encoder(settings)
        self.decoder = Decoder(settings)
        self._prepared: tuple[tuple[Descriptors, Tokens, Prepared], ...] = ()  # by `register`, the last used first

    def describe(self, frame: Frame) -> Descriptors:
        """Descriptors of a frame's points and, if the network has an image branch, its images.

        Raises:
            Dpm2Error: too few points, or the result is not finite.
        """
        return self.encoder.encode(frame)

    @torch.inference_mode()
    def register(self, source: Descriptors, target: Descriptors) -> Registration:
        """Pose of the source in the frame of the target; either may be merged from several frames.

        The result for each set alone is cached for later calls with the same object, such as the map of an odometry.
        """
        with mixed_precision(self._device):
            (y, prepared_target), (x, prepared_source) = self._prepare(target), self._prepare(source)
            correlated = self.decoder.correlate(prepared_source, prepared_target)
            return _in_set_frames(register_batch(self.decoder, x, y, correlated, self.solver)[0], source, target)

    def _prepare(self, descriptors: Descriptors) -> tuple[Tokens, Prepared]:
        """A set prepared for the decoder, computed or from the cache."""
        entry = next((kept for kept in self._prepared if kept[0] is descriptors), None)
        if entry is None:
            tokens = self._tokens([descriptors])
            entry = descriptors, tokens, self.decoder.prepare(tokens)
        others = tuple(kept for kept in self._prepared if kept[0] is not descriptors)
        self._prepared = (entry, *others)[
            :_MAX_PREPARED
        ]  # a new tuple: the SLAM's threads have shallow copies of the network
        return entry[1:]

    @torch.inference_mode()
    def register_many(self, sources: list[Descriptors], targets: list[Descriptors]) -> list[Registration]:
        """`register` for a batch of pairs; nothing is cached."""
        source, target = self._tokens(sources), self._tokens(targets)
        with mixed_precision(self._device):
            correlated = self.decoder(source, target)
            found = register_batch(self.decoder, source, target, correlated, self.solver)
        return [_in_set_frames(*row) for row in zip(found, sources, targets, strict=True)]

    @torch.inference_mode()
    def agreement(self, source: Descriptors, targets: Sequence[Descriptors]) -> list[float]:
        """0..1, how far a set and each of the targets agree on a motion before correlation: `pose_solver.agreement`."""
        s, x = self.settings.decoder, self._tokens([source])
        return [
            float(agreement(x, self._tokens([target]), s.temperature, s.pair_ratio))
            if target.scale == source.scale
            else 0.0
            for target in targets
        ]

    def overlap(self, sources: Sequence[Descriptors], targets: Sequence[Descriptors]) -> list[float]:
        """Probability 0..1 that each pair was seen from within 20 m; NaN while the overlap head is untrained."""
        return [result.overlap for result in self.register_many(list(sources), list(targets))]

    @torch.inference_mode()
    def matches(self, source: Descriptors, target: Descriptors) -> tuple[Array, Array, Array]:
        """The descriptors that `register` pairs: positions (K, 3) in each frame, m, and confidence (K,) 0..1."""
        x, y = self._tokens([source]), self._tokens([target])
        with mixed_precision(self._device):
            correlated = self.decoder(x, y)
            pairs = correspond(self.decoder, x, y, correlated, match_scores(self.decoder, correlated))
        half = pairs.weight.shape[1] // 2  # then the same pairs again, in the other direction
        source_points = pairs.source[0, half:].double().cpu().numpy() / source.scale
        target_points = pairs.target[0, :half].double().cpu().numpy() / target.scale
        weight = pairs.weight[0, :half].double().cpu().numpy()
        return source_points @ source.R_level_set, target_points @ target.R_level_set, weight

    @property
    def _device(self) -> torch.device:
        return next(self.parameters()).device

    def _tokens(self, sets: Sequence[Descriptors]) -> Tokens:
        """A batch of sets in the axes and scale in which they were encoded."""
        return to_tokens([s.as_encoded() for s in sets], self.decoder.view_aligned, self._device)


def _in_set_frames(encoded: Registration, source: Descriptors, target: Descriptors) -> Registration:
    """Convert a registration of encoded sets, in leveled axes and enlarged, to the sets' own axes and scale."""
    if source.scale != target.scale:
        return replace(encoded, ok=False, confidence=0.0, overlap=0.0, reason="one scan is of a room, the other is not")
    if source.scale != 1:
        encoded = _rescaled(encoded, source.scale)
    if source.up is None and target.up is None:
        return encoded
    T_level_source, T_level_target = (se3.make(d.R_level_set, np.zeros(3)) for d in (source, target))
    T = se3.orthonormalized(se3.inverse(T_level_target) @ encoded.T_target_source @ T_level_source)
    A = se3.adjoint(se3.inverse(T_level_source))
    return replace(encoded, T_target_source=T, covariance=A @ encoded.covariance @ A.T)


def _rescaled(result: Registration, scale: float) -> Registration:
    """The registration in true scale, from one of a scene that was enlarged by `scale`."""
    T, S = result.T_target_source.copy(), np.repeat([1.0, 1 / scale], 3)
    T[:3, 3] /= scale
    floor = result.floor[0], result.floor[1] / scale
    covariance = result.covariance * np.outer(S, S)
    return replace(result, T_target_source=T, covariance=covariance, floor=floor, rmse=result.rmse / scale)
