# SPDX-License-Identifier: Apache-2.0
"""`dpm2 config`: the settings and their values."""

from __future__ import annotations

import typer

from dpm2_core.commands.options import ConfigFile, Overrides
from dpm2_core.config import dump_settings, load_settings
from dpm2_core.slam.settings import Config

app = typer.Typer(help="Show the settings.")


@app.command()
def dump(config: ConfigFile = None, settings: Overrides = None) -> None:
    """Print every setting with its description and value, as a YAML file for --config."""
    typer.echo(dump_settings(load_settings(Config, config, settings or [])), nl=False)
