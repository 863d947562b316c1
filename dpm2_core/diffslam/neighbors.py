# SPDX-License-Identifier: Apache-2.0
"""Nearest neighbors in a batch of padded clouds, without gradient: a k-d tree on the CPU, all distances on a GPU."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

_MAX_DISTANCES = 2**27  # distances at once, 1 GiB in float64


class NeighborSearch:
    """Search among the points of clouds (B, N, 3) whose `valid` (B, N) is true; the first one is used if none is."""

    def __init__(self, points: Tensor, valid: Tensor) -> None:
        """Index the clouds, without gradient."""
        self._points = torch.where(valid[..., None], points.detach(), points.new_tensor(torch.inf))
        self._trees: list[tuple[cKDTree, np.ndarray]] = []
        if not points.is_cuda:
            for cloud, mask in zip(points.detach().numpy(), valid.numpy(), strict=True):
                index = np.flatnonzero(mask) if mask.any() else np.zeros(1, np.int64)
                self._trees.append((cKDTree(cloud[index], balanced_tree=False), index))

    def select(self, index: Sequence[int]) -> NeighborSearch:
        """The search in the clouds of the batch at these indices."""
        out = copy(self)
        out._points = self._points[torch.tensor(index, device=self._points.device)]
        out._trees = [self._trees[i] for i in index] if self._trees else []
        return out

    def nearest(self, queries: Tensor, k: int = 1) -> Tensor:
        """(B, M, k) indices of the k points nearest to queries (B, M, 3); a cloud with fewer repeats the nearest."""
        queries = queries.detach()
        return self._nearest_by_tree(queries, k) if self._trees else nearest_by_distance(queries, self._points, k)

    def _nearest_by_tree(self, queries: Tensor, k: int) -> Tensor:
        out = torch.empty(*queries.shape[:2], k, dtype=torch.int64)
        for b, (tree, index) in enumerate(self._trees):
            found = tree.query(queries[b].numpy(), [*range(1, k + 1)], workers=torch.get_num_threads())[1]
            out[b] = torch.from_numpy(index[np.where(found < tree.n, found, found[:, :1])])
        return out


def nearest_by_distance(queries: Tensor, points: Tensor, k: int) -> Tensor:
    """(B, M, k) indices of the k nearest of points (B, N, 3), infinite ones excluded; for a GPU, where a tree is slow.

    As `NeighborSearch.nearest`.
    """
    B, N = points.shape[:2]
    rows = max(1, _MAX_DISTANCES // (B * N))
    found = []
    for part in queries.split(rows, 1):
        # The fast form, |a|^2 + |b|^2 - 2ab, loses centimeters 100 m away.
        distance = torch.cdist(part, points, compute_mode="donot_use_mm_for_euclid_dist")
        distance, index = distance.topk(min(k, N), largest=False) if k > 1 else distance.min(-1, keepdim=True)
        found.append(torch.where(distance.isfinite(), index, index[..., :1]))
    index = torch.cat(found, 1)
    return torch.cat([index, index[..., :1].expand(-1, -1, k - index.shape[-1])], -1)
