# SPDX-License-Identifier: Apache-2.0
"""`dpm2 train`: data (data, pack), image branch, registration (phase1), overlap and confidence (phase2), ablation."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dpm2_core.commands.options import PROCESSORS, InputOverrides, Workers, note
from dpm2_core.config import load_settings
from dpm2_core.console import Console, counted
from dpm2_core.data.source import parse_range
from dpm2_core.errors import Dpm2Error, UsageError, printable

if TYPE_CHECKING:  # torch is slow to import
    from dpm2_core.learning.train_image import ImageTrainingSettings
    from dpm2_core.learning.train_overlap import OverlapTrainingSettings
    from dpm2_core.learning.train_registration import RegistrationTrainingSettings

train = typer.Typer(help="Make training data and train the network.", no_args_is_help=True)

ConfigOption = Annotated[
    Path | None, typer.Option("--config", help="YAML file with settings. Default: the built-in values.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", help="Change a setting: KEY=VALUE, a key as in the YAML file; repeat for more."),
]
OutOption = Annotated[Path, typer.Option("--out", help="Folder for checkpoint, log and weights.")]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Continue from the checkpoint in --out.")]


@train.command()
def data(
    out: Annotated[Path, typer.Argument(help="Folder to fill; existing worlds are kept.")],
    config: ConfigOption = None,
    settings: SetOption = None,
    workers: Workers = PROCESSORS,
) -> None:
    """Simulate scans of many synthetic worlds, and pack them for training."""
    from dpm2_core.learning.generate import GenerateSettings, generate  # torch and embree are slow to import

    chosen = load_settings(GenerateSettings, config, settings or [])
    with counted(f"worlds -> {out}") as progress:
        generate(out, chosen, workers, progress)


@train.command()
def pack(
    src: Annotated[Path, typer.Argument(help="KITTI, KITTI-360 or KITTI-CARLA folder, or a bag; with ground truth.")],
    out: Annotated[Path, typer.Argument(help="Folder for the packed drive; list it in data.packed to train on it.")],
    frames: Annotated[str, typer.Option(help="Frames a to b - 1, as a:b, counted from 0; `:` is all.")] = ":",
    preset: Annotated[str, typer.Option(help="Network preset; sets the crop and the image size to store.")] = "small",
    every: Annotated[
        bool, typer.Option("--all", help="Pack every drive below SRC to OUT/NAME; drives that exist there are kept.")
    ] = False,
    settings: InputOverrides = None,
) -> None:
    """Pack a recorded drive with ground truth, or all drives of a data set, for training, frame by frame."""
    from dpm2_core.data.open import sequences_below
    from dpm2_core.data.settings import input_settings
    from dpm2_core.learning.generate import check_same  # torch and embree are slow to import
    from dpm2_core.network.settings import preset as network_preset

    overrides = settings or []
    input_settings(overrides), network_preset(preset), parse_range(frames)  # reject wrong options before any work
    given = sorted(setting for setting in overrides if not setting.startswith("input.sequence="))
    packing = {"frames": frames, "preset": preset, "input": given}
    if not every:
        if out.exists():
            raise UsageError(f"{out}: exists already; remove it, or choose another folder")
        _pack_one(src, out, packing, overrides)
        return
    if len(given) < len(overrides):
        raise UsageError("--all: packs every drive; omit --set input.sequence=")
    if dataset := input_settings(given).dataset:
        raise UsageError(f"--all: cannot list the drives of input.dataset={dataset}; pack each by its own folder")
    left_out = []
    names = sequences_below(src)
    for name in names:
        drive_overrides = [*overrides, f"input.sequence={name}"]
        drive_packing = {**packing, **_content(src, drive_overrides)}
        if (out / name).exists():
            check_same(out / name, drive_packing)
            continue
        try:
            _pack_one(src, out / name, drive_packing, drive_overrides)
        except UsageError as error:  # affects this drive only; a full disk ends the call
            typer.echo(f"{out / name}: left out: {printable(str(error))}", err=True)
            left_out.append(name)
    if left_out:
        raise Dpm2Error(f"{len(left_out)} of {len(names)} drives were left out: {', '.join(left_out)}")


def _pack_one(src: Path, out: Path, packing: dict[str, Any], overrides: list[str]) -> None:
    """Pack one drive; `packing`: the options that it is made with, which are stored with it."""
    from dpm2_core.data.open import open_source
    from dpm2_core.data.settings import input_settings
    from dpm2_core.learning.generate import pack as write  # torch and embree are slow to import
    from dpm2_core.network.settings import preset as network_preset

    source = open_source(src, input_settings(overrides))
    network, (start, stop) = network_preset(packing["preset"]), parse_range(packing["frames"])
    chosen = range(len(source))[start:stop]
    if not chosen:
        raise UsageError(f"--frames {packing['frames']}: {src} has {len(source)} frames")
    try:
        with counted(f"{source.name} -> {out}") as progress:
            packed = write(source, out, network, chosen, progress, packing)
    finally:
        for text in source.notes:  # such as an image that cannot be read
            note(text)
    remark = f" of {len(chosen)} frames packed; the others have no pose, cannot be read or have too few points"
    note(f"{out}: {packed}{remark if packed < len(chosen) else ' frames packed'}")


def _content(src: Path, overrides: list[str]) -> dict[str, str]:
    """Digest of the content of a drive, see `digest_of`; empty if it cannot be read, e.g. without its scans."""
    from dpm2_core.data.open import open_source
    from dpm2_core.data.settings import input_settings
    from dpm2_core.data.source import digest_of

    try:
        source = open_source(src, input_settings(overrides))
        return {"drive": f"of {len(source)} scans ({digest_of(source)})"}
    except UsageError:
        return {}


@train.command()
def image(
    config: ConfigOption = None,
    settings: SetOption = None,
    out: OutOption = Path("out/image"),
    resume: ResumeOption = False,
) -> None:
    """Train the image branch alone, before the registration training with images."""
    from dpm2_core.learning.train_image import ImageTrainingSettings, train_image

    chosen = load_settings(ImageTrainingSettings, config, settings or [])
    _begin_training(out, resume, chosen)
    train_image(chosen, out)


@train.command()
def phase1(
    config: ConfigOption = None,
    settings: SetOption = None,
    out: OutOption = Path("out/phase1"),
    resume: ResumeOption = False,
) -> None:
    """Train the registration: encoder, decoder, similarity and offset heads."""
    from dpm2_core.learning.train_registration import RegistrationTrainingSettings, train_registration

    chosen = load_settings(RegistrationTrainingSettings, config, settings or [])
    _begin_training(out, resume, chosen)
    train_registration(chosen, out)


@train.command()
def phase2(
    config: ConfigOption = None,
    settings: SetOption = None,
    out: OutOption = Path("out/phase2"),
    resume: ResumeOption = False,
) -> None:
    """Train the heads that judge a pose, overlap and confidence, on the network of the registration training."""
    from dpm2_core.learning.train_overlap import OverlapTrainingSettings, train_overlap

    chosen = load_settings(OverlapTrainingSettings, config, settings or [])
    _begin_training(out, resume, chosen)
    train_overlap(chosen, out)


@train.command()
def ablation(
    config: ConfigOption = None,
    settings: SetOption = None,
    out: OutOption = Path("out/ablation"),
) -> None:
    """Make the paper's tables 3 and 4: alternatives of the fusion and its reference points, all trained the same way.

    A stopped ablation continues. The figures are written to ablation.json in --out.
    """
    from dpm2_core.data.packed import open_packed, scans_of
    from dpm2_core.evaluation.record import write_record
    from dpm2_core.experiments.ablation import AblationSettings, ablation_tables, gains
    from dpm2_core.experiments.ablation import ablation as compare
    from dpm2_core.learning.begun import check_one_process

    check_one_process("train ablation")
    chosen = load_settings(AblationSettings, config, settings or [])
    if not chosen.measure:
        raise UsageError("measure: set the folders of packed drives to measure on, such as {unseen: out/train/val}")
    packed = chosen.training.data.packed
    learned = scans_of(drive for folder, weight in packed.items() if weight for drive in open_packed(Path(folder)))
    for name, folder in chosen.measure.items():
        note_packed_training_scans(f"measure.{name}", Path(folder), learned)
    found = compare(chosen, out)
    results = {"settings": chosen.model_dump(mode="json"), "variants": found, "gains": gains(found)}
    report = out / "ablation.json"
    write_record(report, results)
    for table in ablation_tables(found):
        Console().print(table)
    Console().print(f"written to {report}")


def _begin_training(
    out: Path, resume: bool, settings: ImageTrainingSettings | RegistrationTrainingSettings | OverlapTrainingSettings
) -> None:
    """Prepare `out` for a training on packed drives, see `begin_or_resume`."""
    from dpm2_core.data.packed import open_packed, packed_digest, scans_of
    from dpm2_core.learning.begun import begin_or_resume, is_first_process
    from dpm2_core.network.pretrained import weights_path

    drives = {folder: open_packed(Path(folder)) for folder in settings.data.packed}
    frames = {folder: sum(map(len, found)) for folder, found in drives.items()}
    content = {folder: packed_digest(found) for folder, found in drives.items()}
    start_weights = [weights_path(settings.start)] if settings.start else []
    begin_or_resume(out, resume, settings, start_weights, {"frames": frames, "content": content})
    validation = getattr(settings, "validation", "")  # the training of the image branch has none
    if validation and is_first_process():
        learned = scans_of(d for folder, found in drives.items() if settings.data.packed[folder] for d in found)
        note_packed_training_scans(f"validation {validation}", Path(validation), learned)


def note_packed_training_scans(what: str, folder: Path, learned: Collection[bytes]) -> None:
    """Print which packed drives below a folder contain scans that are also used for training, see `scans_of`."""
    from dpm2_core.data.packed import open_packed, scans_of

    measured = open_packed(folder)
    both = {drive.folder.resolve() for drive in measured if not scans_of([drive]).isdisjoint(learned)}
    note_training_scans(f"{what}: the network", {drive.folder.resolve(): drive.name for drive in measured}, both)


def note_training_scans(what: str, measured: Mapping[Path, str], learned: Collection[Path]) -> None:
    """Print which measured drives (name by folder) are also used for training: their figures are no evidence."""
    both = [name for folder, name in measured.items() if folder in learned]
    if both:
        which = "" if len(both) == len(measured) else f": {', '.join(both)}"
        note(f"note: {what} trains on these scans{which}")
