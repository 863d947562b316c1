# SPDX-License-Identifier: Apache-2.0
"""`dpm2 show`: draw two scans with their matched descriptors, and an image with the attention of the network."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dpm2_core.commands.options import InputOverrides, note
from dpm2_core.errors import UsageError

if TYPE_CHECKING:
    from dpm2_core.data.source import Source
    from dpm2_core.frame import Frame


def show(
    src: Annotated[Path, typer.Argument(help="Any recording that `dpm2 run` reads.")],
    first: Annotated[int, typer.Argument(metavar="A", min=0, help="First frame: its position, from 0.")],
    second: Annotated[int, typer.Argument(metavar="B", min=0, help="Frame that is registered to A.")],
    out: Annotated[Path, typer.Option(help="PNG file to write.")] = Path("matches.png"),
    weights: Annotated[
        list[str] | None,
        typer.Option(
            show_default="small",
            help="Name of shipped weights, or a .safetensors file; repeat to draw several below each other.",
        ),
    ] = None,
    corrupt: Annotated[str | None, typer.Option(help="Simulate sensor failures, as in `dpm2 run`.")] = None,
    settings: InputOverrides = None,
) -> None:
    """Draw two scans from above with their matched descriptors, colored by confidence, and how they fit.

    With weights that use a camera, also draw the image attention of the reference point nearest to the image center.
    """
    from dpm2_core.data.corrupt import CorruptedSource, parse_corruption
    from dpm2_core.data.open import open_source
    from dpm2_core.data.settings import input_settings
    from dpm2_core.evaluation.image_attention import image_attention
    from dpm2_core.evaluation.matches import compared_png
    from dpm2_core.network.pretrained import load_network

    corruption = None if corrupt is None else parse_corruption(corrupt)
    models = {name: load_network(name, threads=2) for name in weights or ["small"]}
    chosen = input_settings(settings or [])
    images = chosen.images and any(model.encoder.image is not None for model in models.values())
    source: Source = open_source(src, chosen.model_copy(update={"images": images}))
    if corruption is not None:
        source = CorruptedSource(source, corruption)
    target, moving = _frame(source, src, first), _frame(source, src, second)
    title = f"{source.name}, frame {moving.index} to frame {target.index}{f', {corrupt}' if corrupt else ''}"
    panels = []
    for name, model in models.items():
        attention = image_attention(model, moving) if model.encoder.image is not None and moving.images else None
        panels.append((f"{title}, {Path(name).stem}" if len(models) > 1 else title, model, attention))
    compared_png(out, panels, moving, target)
    note(f"{out}: {title}")


def _frame(source: Source, src: Path, position: int) -> Frame:
    from dpm2_core.data.source import frame_at

    if position >= len(source):
        raise UsageError(f"frame {position}: {src} has {len(source)} frames")
    frame = frame_at(source, position)
    if frame.problem:
        raise UsageError(f"frame {position} of {src}: {frame.problem}")
    return frame
