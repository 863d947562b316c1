# SPDX-License-Identifier: Apache-2.0
"""`dpm2 doctor`: what this machine has, what is missing, and how fast it is."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from dpm2_core.commands.options import JsonFile, show
from dpm2_core.console import Console
from dpm2_core.errors import Dpm2Error
from dpm2_core.tables import FigureTable


def doctor(
    folder: Annotated[Path, typer.Option(help="Folder for results, whose free disk space is checked.")] = Path(),
    no_test: Annotated[bool, typer.Option("--no-test", help="Skip the self-test, which takes ten seconds.")] = False,
    json_file: JsonFile = None,
) -> None:
    """Check this machine: versions, processor, GPU, memory, disk, ROS 2 and DDS; then test the SLAM for ten seconds.

    The exit code is 1 if something does not work. What is only missing or slow is reported, but is not an error.
    """
    from dpm2_core.evaluation.machine import Finding, check_machine
    from dpm2_core.evaluation.self_test import self_test  # the self-test imports everything

    findings: list[Finding] = []
    with Console(stderr=True).status("") as status:
        for finding in check_machine(folder):
            findings.append(finding)
            status.update(f"{finding.what}: {finding.found}")
        if not no_test:
            status.update("self-test of the SLAM, ten seconds")
            findings.append(self_test().finding())
    table = FigureTable("This machine", names=["what", "status"], text=["found"])
    for finding in findings:
        advice = f"; {finding.advice}" if finding.advice else ""
        table.add_row(finding.what, finding.level, finding.found + advice)
    show(table, {"findings": [asdict(finding) for finding in findings]}, json_file)
    if broken := [finding.what for finding in findings if finding.level == "error"]:
        raise Dpm2Error(f"doctor: these do not work: {', '.join(broken)}")
