# SPDX-License-Identifier: Apache-2.0
"""`dpm2 finetune`: fine-tune the network on a user's own drives and LiDAR, without ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpm2_core.commands.options import JsonFile, note, show
from dpm2_core.commands.train import ConfigOption, OutOption, ResumeOption, SetOption
from dpm2_core.config import load_settings
from dpm2_core.console import Console
from dpm2_core.tables import FigureTable


def finetune(
    src: Annotated[list[Path], typer.Argument(help="Recordings of any format that `dpm2 run` reads.")],
    out: OutOption = Path("out/finetune"),
    config: ConfigOption = None,
    settings: SetOption = None,
    resume: ResumeOption = False,
    json_file: JsonFile = None,
) -> None:
    """Fine-tune the network on drives without ground truth. The trajectory of the SLAM serves as the reference.

    Run the result with --set slam.neural.weights=OUT/weights.safetensors.
    """
    import torch  # slow to import

    from dpm2_core.data.open import open_source
    from dpm2_core.data.packed import open_packed, packed_digest
    from dpm2_core.learning import finetune as work
    from dpm2_core.learning import finetune_data, finetune_settings
    from dpm2_core.learning.begun import begin_or_resume, check_one_process
    from dpm2_core.network.pretrained import weights_path
    from dpm2_core.network.weights import network_settings
    from dpm2_core.slam.settings import SlamSettings

    check_one_process("finetune")
    chosen = load_settings(finetune_settings.FinetuneSettings, config, settings or [])
    start = weights_path(chosen.weights)
    data: dict[str, object] = {"SRC": [str(path.resolve()) for path in src]}
    if chosen.rehearsal:
        data["content of rehearsal"] = packed_digest(open_packed(Path(chosen.rehearsal)))
    sources = [open_source(path, chosen.input) for path in src]  # before anything is written
    begin_or_resume(out, resume, chosen, [start], data)
    slam = SlamSettings(threads=torch.get_num_threads())  # applies to the process, training included
    console = Console(stderr=True)
    with console.status("") as status:
        for text in finetune_data.prepare(sources, chosen, network_settings(start), slam, out, status.update):
            console.print(text, soft_wrap=True)
        status.update("measuring")
        before = work.measure(start, chosen, out)
    written = work.finetune(chosen, out)
    with console.status("measuring"):
        after = work.measure(written, chosen, out)
    title = "Held-out parts, measured with the SLAM's trajectory"
    table = FigureTable(title, names=["median error of pairs"], figures=["before", "after"])
    for name, figures in before.items():
        for figure in (figure for figure in figures if figure in after[name]):
            table.add_row(f"{name}, {figure}", f"{figures[figure]:.3f}", f"{after[name][figure]:.3f}")
    show(table, {"weights": str(written), "before": before, "after": after}, json_file)
    note(f"{written}: written")
