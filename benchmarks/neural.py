# SPDX-License-Identifier: Apache-2.0
"""The network: pairs of unseen synthetic and real frames, odometry, and speed, compared with classical methods."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks.figures import success_png
from benchmarks.geometric import BASELINE, Method, dpm2, kiss_icp, summary
from benchmarks.harness import (
    Options,
    Report,
    drives,
    earlier,
    installed,
    processors,
    quantiles_ms,
    requested,
    settings_of,
    truth_of,
    write_report,
)
from benchmarks.neural_view import view
from benchmarks.pairs import APART, PairMethod, all_pairs, by_registration, gicp_from_identity, kiss_from_identity
from benchmarks.reference_points import repeated
from benchmarks.unseen import corruption, image_matters, overlap, synthetic
from benchmarks.unseen_sensors import other_sensors
from dpm2_core.console import progress_bar
from dpm2_core.data.packed import open_packed, packed_digest
from dpm2_core.data.source import digest_of
from dpm2_core.errors import UsageError
from dpm2_core.evaluation.record import git_commit
from dpm2_core.files import file_digest
from dpm2_core.frame import Array, Frame
from dpm2_core.network.images import small_image
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.pretrained import load_network, weights_path
from dpm2_core.network.pyramid import build_pyramid, collate, crop
from dpm2_core.network.views import collate_views
from dpm2_core.network.weights import read_metadata
from dpm2_core.slam.build import make_registration

Part = Callable[[DeepPointMap2, Options], dict[str, Any]]


def bench_neural(options: Options) -> Report:
    """Run the parts one by one; each is written to the JSON when it is complete. A later run with the same weights,
    options and drives adds the missing parts.

    Raises:
        UsageError: no weights, no drive, one without ground truth, or no such part.
    """
    chosen = requested(options, PARTS)
    s = settings_of(options)
    network = load_network(s.neural.weights, options.threads)
    weights = _weights(s.neural.weights)
    path = options.out / "neural.json"
    same = {"weights": weights, "options": _options(options)}
    parts = earlier(path, "parts", **same)
    chosen = [name for name in chosen if options.only or name not in parts]
    with processors(options.threads), progress_bar() as progress:
        task = progress.add_task("neural", total=len(chosen))
        for name in chosen:
            progress.update(task, description=name)
            started = perf_counter()
            found = PARTS[name](network, options)
            parts[name] = {"commit": git_commit(), "seconds": round(perf_counter() - started, 1), **found}
            parts = {known: parts[known] for known in PARTS if known in parts}
            report = Report({**same, "parts": parts}, view(parts))
            write_report(path, report, options)
            if name == "image":
                title = "Highway and tunnel, pairs without a prior"
                success_png(options.out / "neural_image.png", found["pairs"], title)
            progress.advance(task)
            progress.console.print(f"{name}: {parts[name]['seconds']} s")
    return Report({**same, "parts": parts}, view(parts))


def _options(options: Options) -> dict[str, Any]:
    """Properties common to all parts of a record: parts with other options do not belong in the same tables."""
    return {
        "sources": [path.name for path in options.sources],
        "unseen": options.unseen and options.unseen.name,  # a record must not name folders of a machine
        "content": _content(options),
        "overrides": list(options.overrides),
        "repetitions": options.repetitions,
        "threads": options.threads,
        "pairs": options.pairs,
    }


def _content(options: Options) -> dict[str, str]:
    """Digests of the drives and worlds: another one may have the same name. If some are missing, the parts that need
    them report it."""
    found: dict[str, str] = {}
    with suppress(UsageError), drives(options) as sources:
        found |= {name: digest_of(source) for name, source in sources.items()}
    with suppress(UsageError):
        if options.unseen is not None:
            found["unseen"] = packed_digest(open_packed(options.unseen))
    return found


def _weights(name: str) -> dict[str, Any]:
    path = weights_path(name)
    about = read_metadata(path)
    about.pop("network", None)
    return {"name": name, "bytes": path.stat().st_size, "sha256": file_digest(path), **about}


def _for_each_drive(evaluate: Callable[[Array, list[Frame], DeepPointMap2, Options], Any]) -> Part:
    """A part that runs the same function on every drive."""

    def part(network: DeepPointMap2, options: Options) -> dict[str, Any]:
        found: dict[str, Any] = {}
        truth: dict[str, str] = {}
        with drives(options) as sources:
            for name, source in sources.items():
                poses, frames = truth_of(source), list(source.frames())
                if network.encoder.image is None:
                    frames = [replace(frame, images=()) for frame in frames]
                found[name], truth[name] = evaluate(poses, frames, network, options), source.truth
        return {"drives": found, "truth": truth}

    return part


def real_pairs(poses: Array, frames: list[Frame], network: DeepPointMap2, options: Options) -> dict[str, Any]:
    """Near pairs with the network, alone and refined by point-to-plane registration; pairs 10 m apart or more with all
    methods; none with a prior. The network's errors are also given against poses fitted with the points."""
    methods: dict[str, PairMethod] = {
        name: by_registration(make_registration(settings_of(options, f"slam.registration={name}")))
        for name in ("neural", "refined", "geometric")
    }
    near = {name: methods[name] for name in ("neural", "refined")}
    peers: dict[str, Callable[[int], PairMethod]] = {"small_gicp": gicp_from_identity, BASELINE: kiss_from_identity}
    methods |= installed({name: partial(make, options.threads) for name, make in peers.items()})
    kinds = {"consecutive": near, "8 apart": near} | dict.fromkeys(APART, methods)
    points = make_registration(settings_of(options, "slam.registration=geometric"))
    return all_pairs(kinds, frames, poses, options.pairs, points)


def odometry(poses: Array, frames: list[Frame], network: DeepPointMap2, options: Options) -> dict[str, Any]:
    """Odometry as in `dpm2 run`, with the network, refined and geometric registration, and KISS-ICP."""
    methods: dict[str, Method] = {
        name: dpm2(options, f"slam.registration={name}") for name in ("neural", "refined", "geometric")
    }
    methods |= installed({BASELINE: partial(kiss_icp, options)})
    trials: dict[str, list[Any]] = {name: [] for name in methods}
    for _ in range(options.repetitions):
        for name, run in methods.items():
            trials[name].append(run(frames))
    rows = {name: summary(poses, trials[name]) for name in methods}
    if BASELINE in rows:
        for row in rows.values():
            row["frame_ms"]["ratio"] = round(row["frame_ms"]["median"] / rows[BASELINE]["frame_ms"]["median"], 3)
    return rows


def speed(poses: Array, frames: list[Frame], network: DeepPointMap2, options: Options) -> dict[str, Any]:
    """Encode and register, raw points to pose, by stages; alternating with KISS-ICP; and the camera's added time."""
    frames = frames[:60]
    peers, rounds = installed({BASELINE: partial(kiss_icp, options)}), []
    for _ in range(options.repetitions):
        rounds.append((stage_times(network, frames), {name: run(frames).seconds[1:] for name, run in peers.items()}))
    best, peer_seconds = min(rounds, key=lambda r: r[0]["stages_ms"]["total"]["median"])
    out: dict[str, Any] = {**best, **{name: quantiles_ms(seconds) for name, seconds in peer_seconds.items()}}
    if BASELINE in out:
        out["ratio"] = round(best["stages_ms"]["total"]["median"] / out[BASELINE]["median"], 3)
    if network.encoder.image is None:
        out["with the camera"] = "not answered: these weights have no camera"
    else:
        without_camera = stage_times(network, [replace(frame, images=()) for frame in frames])
        out["without_camera_ms"] = without_camera["stages_ms"]["total"]
    return out


def stage_times(network: DeepPointMap2, frames: Sequence[Frame]) -> dict[str, Any]:
    """Time of each stage from raw points to a pose, frame to frame, and the size of a frame's descriptors, bytes."""
    encoder, points = network.encoder, network.settings.points
    clocks, before, size = [], None, 0
    for frame in frames:
        clock = [perf_counter()]
        cloud = crop(frame.points, points)
        clock.append(perf_counter())
        images = [small_image(image, network.settings.image) for image in frame.images if encoder.image is not None]
        views = collate_views([images], network.settings.image)
        clock.append(perf_counter())
        pyramid = build_pyramid(cloud, network.settings, images)
        clock.append(perf_counter())
        descriptors = encoder.encode_batch(collate([pyramid]), views)[0]
        clock.append(perf_counter())
        network.register(descriptors, before or descriptors)
        clock.append(perf_counter())
        clocks.append([b - a for a, b in pairwise(clock)])
        before, size = descriptors, descriptors.nbytes
    times = np.array(clocks)[1:]  # the first call allocates
    names = ("crop and voxels", "pictures", "sampling and neighbors", "encoder", "decoder and pose")
    stages = {name: quantiles_ms(column) for name, column in zip(names, times.T, strict=True)}
    return {"stages_ms": {**stages, "total": quantiles_ms(times.sum(1))}, "descriptor_bytes": size}


PARTS: Mapping[str, Part] = {
    "synthetic": synthetic,
    "real": _for_each_drive(real_pairs),
    "odometry": _for_each_drive(odometry),
    "corruption": corruption,
    "image": image_matters,
    "sensors": other_sensors,
    "overlap": overlap,
    "reference": repeated,
    "speed": _for_each_drive(speed),
}
"""Parts by name, as in `--only` and the JSON."""
