# SPDX-License-Identifier: Apache-2.0
"""Loop closure: candidates by descriptors and by pose; each is registered and verified before it is accepted.

A candidate must pass four checks. Odometry: its drift is limited, so places beyond the limit are not candidates at all.
Network: it finds the candidate and registers it without a start. Points: those of the new keyframe must fit the map
around the candidate. Second loop: a large correction must be confirmed by another loop. If the odometry between the two
ends is unknown, as between two drives or across a gap, the candidate must also fit clearly better than any other place.
Rejected candidates are kept with the reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dpm2_core.config import Settings
from dpm2_core.errors import Dpm2Error
from dpm2_core.estimates import Edge, Keyframe, Registration
from dpm2_core.frame import Array, Points
from dpm2_core.geometry import se3
from dpm2_core.geometry.scale import ByScale
from dpm2_core.slam.loops.consistency import Consistency, ConsistencySettings, OdometryChain, margin
from dpm2_core.slam.loops.place_recognition import AGREEING, PlaceRecognition, merged
from dpm2_core.slam.loops.verification import SAME_PLACE, Verifier, looks_elsewhere, objection_of_others

if TYPE_CHECKING:  # torch takes seconds to import
    from dpm2_core.network.model import DeepPointMap2

_MAX_VIEW_DISTANCE = 40.0  # m, maximum distance of two keyframes that see the same; rooms are enlarged
_DRIFT = 0.01  # m per m of path, drift of the odometry: added to the radius of the search by pose
_MERGE_DISTANCE = 6.0  # m, path around a keyframe whose descriptors are merged with its own; rooms are enlarged


class LoopSettings(Settings):
    """Search and verification of loops."""

    enabled: bool = True
    """Close loops."""
    descriptors: bool = True
    """Find loops by neural descriptors (`neural.weights`); then every keyframe has them, whatever registers the scans.
    Without them, only keyframes that are near by their pose are candidates."""
    gap: float = Field(50.0, ge=0)
    """Path that must lie between two keyframes of a loop, m."""
    candidates: int = Field(4, ge=1)
    """Number of keyframes most similar to the new one that the network registers..."""
    verified: int = Field(2, ge=1)
    """...and of those, the most confident first, that are registered by their points."""
    min_overlap: float = Field(0.2, ge=0, le=1)
    """Probability of the network's overlap head, below which a candidate is rejected before its points are used."""
    decided_by: Literal["points", "overlap"] = "points"
    """What accepts a candidate of the network: the points and a second loop; or, as in the paper, its overlap head
    alone, which then also selects the best candidate."""
    radius: float = Field(8.0, ge=0)
    """The keyframe nearest by its pose is a candidate, too, if nearer than this, m, plus 1 % of the path since."""
    surroundings: float = Field(22.0, gt=0)
    """Keyframes within this distance of a candidate along the path make up the map to register to, m."""
    consistency: ConsistencySettings = ConsistencySettings()


class LoopCloser:
    """Finds and verifies the loops of each new keyframe. A node is the index of a keyframe in the map."""

    def __init__(self, by_scene: ByScale[tuple[LoopSettings, Verifier]], network: DeepPointMap2 | None = None) -> None:
        """`by_scene`: settings and verifier, by the type of scene that a keyframe shows."""
        self._by_scene = by_scene
        self._settings, self._verifier = by_scene.outdoor
        self._places = PlaceRecognition(network) if network is not None else None
        self._path = OdometryChain()
        self._consistency = Consistency(self._path)

    @property
    def channels(self) -> int | None:
        """Width of the network's features; None without a network."""
        return None if self._places is None else self._places.channels

    @property
    def _decided_by_overlap(self) -> bool:
        """Whether the overlap head alone decides, as in the paper: then it is computed for every candidate."""
        return self._settings.decided_by == "overlap"

    def described(self, keyframe: Keyframe) -> Keyframe:
        """The keyframe with descriptors, made from its cloud if needed; unchanged if it has none."""
        if keyframe.descriptors is not None or self._places is None:
            return keyframe
        try:
            return replace(keyframe, descriptors=self._places.descriptors(keyframe))
        except Dpm2Error:  # too few points: no loop starts or ends there
            return keyframe

    def close(
        self,
        keyframes: Sequence[Keyframe],
        clouds: Sequence[Points],
        poses: Array,
        parts: NDArray[np.integer],
        own: NDArray[np.bool_] | None = None,
    ) -> list[Edge]:
        """Try to close loops with the last keyframe.

        Args:
            keyframes: all of them. clouds: theirs, each (M, 4) in its own frame. poses: (N, 4, 4) T_map_kf.
            parts: (N,) part of the map of each keyframe: the relative pose of two parts is unknown.
            own: (N,) mask of keyframes with their own descriptors. Borrowed ones match only the lender; they would
                confirm the lender's own loop, a single witness. None: all.

        Returns:
            Every candidate, accepted or rejected with its reason, and earlier ones that it confirms.
        """
        for node in range(len(self._path), len(keyframes)):
            self._path.append(keyframes[node])
        if self._places is not None:
            self._places.update(keyframes)
        node = len(keyframes) - 1
        own = np.ones(len(keyframes), np.bool_) if own is None else own
        if not self._settings.enabled or node < 1 or not own[node]:
            return []
        self._settings, self._verifier = self._by_scene.suited_to(clouds[node])
        self._consistency.update(poses, parts)
        since = self._path.since(node)
        rejections, proposals = self._propose(since, keyframes, poses, own)
        if self._decided_by_overlap:
            return rejections + proposals[:1]
        max_verified, failed = self._settings.verified, list[Edge]()
        for number, proposal in enumerate(proposals[:max_verified]):
            loop = self._verify(proposal, keyframes, clouds, poses)
            if not loop.ok:
                failed.append(loop)
                continue
            if self._consistency.is_first(loop, self._settings.consistency):
                others = [f for f in failed if _is_elsewhere(f, loop, poses)]
                unseen = [p for p in proposals[number + 1 :] if _is_elsewhere(p, loop, poses)]
                others += [self._verify(p, keyframes, clouds, poses) for p in unseen]
                if objection := objection_of_others(loop.registration, [o.registration for o in others]):
                    return [*rejections, *failed, loop.rejected(objection)]
            return rejections + failed + self._consistency.check(loop, self._settings.consistency)
        return rejections + failed + [p.rejected("others are more likely") for p in proposals[max_verified:]]

    def _propose(
        self, since: Array, keyframes: Sequence[Keyframe], poses: Array, own: NDArray[np.bool_]
    ) -> tuple[list[Edge], list[Edge]]:
        """Candidates that the network rejected, and those to verify by their points, the most likely first."""
        node, s = len(keyframes) - 1, self._settings
        descriptors = keyframes[node].descriptors
        distance = np.linalg.norm(poses[:, :3, 3] - poses[node, :3, 3], axis=1)
        nearest = None if self._decided_by_overlap else self._nearest_by_pose(since, distance)
        rejections: list[Edge] = []
        proposals: list[Edge] = []
        if self._places is not None and descriptors is not None:
            allowed = own & (since > s.gap)
            if not self._decided_by_overlap:  # leave out what the odometry check would reject in any case
                allowed &= distance <= _MAX_VIEW_DISTANCE / descriptors.scale + margin(since, s.consistency)
            similar = self._places.similar(descriptors, allowed, s.candidates)
            found = self._register(node, similar, keyframes)
            rank = "overlap" if self._decided_by_overlap else "confidence"
            for loop in sorted(found, key=lambda loop: -getattr(loop.registration, rank)):
                r = loop.registration
                if not r.ok:
                    rejections.append(loop)
                elif self._decided_by_overlap and np.isnan(r.overlap):
                    rejections.append(loop.rejected("the overlap head of these weights is not trained"))
                elif r.overlap < s.min_overlap:  # NaN of an untrained head rejects nothing
                    rejections.append(loop.rejected(f"the places overlap with a probability of only {r.overlap:.2f}"))
                else:
                    proposals.append(loop)
        if nearest is not None and all(abs(loop.from_node - nearest) > 1 for loop in proposals):
            T_guess = se3.inverse(poses[nearest]) @ poses[node]
            by_pose = Registration(T_guess, np.eye(6), 0.0, 0.0, "pose")
            proposals.insert(min(len(proposals), 1), Edge("loop", nearest, node, by_pose))
        return rejections, proposals

    def _register(self, node: int, candidates: Sequence[int], keyframes: Sequence[Keyframe]) -> list[Edge]:
        """The network's registration of each candidate."""
        assert self._places is not None
        source = keyframes[node].descriptors
        targets = [keyframes[c].descriptors for c in candidates]
        assert source is not None
        known = [t for t in targets if t is not None]
        results = self._places.register(source, known, 0.0 if self._decided_by_overlap else AGREEING)
        return [Edge("loop", c, node, result) for c, result in zip(candidates, results, strict=True)]

    def _nearest_by_pose(self, since: Array, distance: Array) -> int | None:
        """The keyframe nearest by its pose, if it is near enough for the drift since then."""
        s = self._settings
        near = np.flatnonzero((since > s.gap) & np.isfinite(since) & (distance < s.radius + _DRIFT * since))
        return int(near[np.argmin(distance[near])]) if len(near) else None

    def _verify(self, proposal: Edge, keyframes: Sequence[Keyframe], clouds: Sequence[Points], poses: Array) -> Edge:
        """Verify by the points; if that fails, again from the pose by the merged descriptors around both ends."""
        nodes = self._nodes_around(proposal.from_node, proposal.to_node, self._settings.surroundings)
        T_candidate_kf = se3.inverse(poses[proposal.from_node]) @ poses[nodes]
        around = self._verifier.surroundings([clouds[n] for n in nodes], T_candidate_kf)
        proposed = proposal.registration
        by_pose = proposed.method == "pose"
        cloud = clouds[proposal.to_node]
        result = self._verifier.verify(cloud, around, proposed.T_target_source, 2.0 if by_pose else 1.0)
        if not result.ok and not by_pose:
            again = self._register_map_to_map(proposal, keyframes, poses)
            if again.ok:
                second = self._verifier.verify(cloud, around, again.T_target_source)
                result = second if second.ok else result
        return replace(proposal, registration=result)

    def _register_map_to_map(self, proposal: Edge, keyframes: Sequence[Keyframe], poses: Array) -> Registration:
        """T_from_to by the descriptors of the keyframes around both ends."""
        assert self._places is not None
        a, b = proposal.from_node, proposal.to_node
        own = keyframes[b].descriptors
        assert own is not None
        reach = _MERGE_DISTANCE / own.scale
        before = np.flatnonzero(self._path.since(b) <= reach)
        source = merged(keyframes, poses, before.tolist(), b)
        target = merged(keyframes, poses, self._nodes_around(a, b, reach), a)
        return self._places.register(source, [target])[0]

    def _nodes_around(self, candidate: int, node: int, reach: float) -> list[int]:
        """The candidate and the nodes within `reach` m of it along the path, without those just before the new one."""
        near = (self._path.since(candidate) <= reach) & (self._path.since(node) > self._settings.gap / 2)
        return np.flatnonzero(near).tolist()


def _is_elsewhere(one: Edge, other: Edge, poses: Array) -> bool:
    """Whether two loops place the new keyframe at different positions or headings in the map (N, 4, 4).

    A place that is not connected to the map yet counts as different: if it fits as well, both are doubtful.
    """
    T_one, T_other = (poses[loop.from_node] @ loop.T_from_to for loop in (one, other))
    return bool(np.linalg.norm(T_one[:3, 3] - T_other[:3, 3]) > SAME_PLACE) or looks_elsewhere(T_one, T_other)
