# SPDX-License-Identifier: Apache-2.0
"""Choice of the descriptor sets of a batch that are registered: pairs of frames, and merged sets, as in maps."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dpm2_core.geometry.full_precision import full_precision
from dpm2_core.geometry.se3_torch import transform
from dpm2_core.network.tokens import Tokens


class SetPairs(NamedTuple):
    """Set pairs of a batch of encoded frames.

    Attributes:
        source, target: (B, S) and (B, R) indices of the frames that each side merges, in the frame of its first one.
        T_source, T_target: (B, S, 4, 4) and (B, R, 4, 4), of each member to the first of its side.
        T_target_source: (B, 4, 4) truth between the first ones.
    """

    source: Tensor
    target: Tensor
    T_source: Tensor
    T_target: Tensor
    T_target_source: Tensor


def sample_set_pairs(
    poses: Tensor, per_group: int, sides: tuple[int, int], radius: float, noise: torch.Generator
) -> SetPairs:
    """Draw `per_group` set pairs from every group.

    Args:
        poses: (G, F, 4, 4) float64. sides: frames of source and target. radius: m, between the first ones of the sides.
    """
    groups, frames = poses.shape[:2]
    count = sum(sides)
    rows, truth = [], []
    for group in range(groups):
        t = poses[group, :, :3, 3]
        close = torch.cdist(t, t) <= radius
        for _ in range(per_group):
            order = torch.randperm(frames, generator=noise)[:count]
            for _ in range(20):
                if close[order[0], order[sides[0]]]:
                    break
                order = torch.randperm(frames, generator=noise)[:count]
            else:
                order = torch.tensor([0, *range(1, count)])
            rows.append(order + group * frames)
            truth.append(poses[group, order])
    index, T = torch.stack(rows), torch.stack(truth)
    inverse = torch.linalg.inv(T)
    first, second = 0, sides[0]
    return SetPairs(
        index[:, :second],
        index[:, second:],
        (inverse[:, None, first] @ T[:, :second]).float(),
        (inverse[:, None, second] @ T[:, second:]).float(),
        (inverse[:, second] @ T[:, first]).float(),
    )


@full_precision
def _rotate_axes(axis: Tensor, T: Tensor) -> Tensor:
    """Axes (B, N, 2), rotated by T (B, 4, 4), not yet of length 1."""
    return axis @ T[:, :2, :2].transpose(1, 2)


def merge_tokens(tokens: Tokens, index: Tensor, T: Tensor, view_aligned: bool) -> Tokens:
    """Sets (B, S * N) of frames index (B, S) of a batch of tokens, moved by T (B, S, 4, 4).

    If the network is not `view_aligned`, the offsets are in the axes of the set, and `axis` stays (1, 0), as from
    `to_tokens` at inference.
    """
    batch, size = index.shape
    members = tokens.at(index)
    if size == 1:  # already in its own frame
        return members
    T = T.flatten(0, 1)
    xyz, axis = transform(T, members.xyz), members.axis
    if view_aligned:
        axis = _rotate_axes(axis, T)
        axis = axis / axis.norm(dim=-1, keepdim=True).clamp(min=1e-6)

    def merge_frames(x: Tensor) -> Tensor:
        return x.reshape(batch, -1, *x.shape[2:])

    return Tokens(merge_frames(xyz), merge_frames(members.features), merge_frames(axis), merge_frames(members.mask))
