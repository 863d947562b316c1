# SPDX-License-Identifier: Apache-2.0
"""The `dpm2` command. Errors of use exit with 2 and one line on stderr, failures of the work with 1."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import typer

from dpm2_core import __version__
from dpm2_core.commands import bench, config, convert, eval, finetune, map, run, show, sim, tasks, train
from dpm2_core.errors import Dpm2Error, UsageError, printable

app = typer.Typer(help="LiDAR-visual SLAM.", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
app.command()(run.run)
app.command("eval")(eval.eval_)
app.command()(show.show)
app.command()(sim.sim)
app.command()(bench.bench)
app.command()(finetune.finetune)
app.command("eval-task")(tasks.eval_task)
app.add_typer(convert.app, name="convert")
app.add_typer(config.app, name="config")
app.add_typer(map.app, name="map")
app.add_typer(train.train, name="train")


@app.command()
def version() -> None:
    """Print the version."""
    typer.echo(__version__)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the console script."""
    sys.exit(_status(arguments))


def _status(arguments: Sequence[str] | None) -> int:
    try:
        return app(args=list(arguments) if arguments is not None else None, standalone_mode=False) or 0
    except UsageError as error:
        print(f"dpm2: {printable(str(error))}", file=sys.stderr)
        return 2
    except Dpm2Error as error:
        print(f"dpm2: {printable(str(error))}", file=sys.stderr)
        return 1
    except Exception as error:
        # click's own errors of use (an unknown option, a missing argument) know their exit code and their message.
        message, code = getattr(error, "format_message", None), getattr(error, "exit_code", None)
        if message is None or code is None:
            raise
        print(f"dpm2: {' '.join(message().split()) or 'see dpm2 --help'}", file=sys.stderr)
        return int(code)


if __name__ == "__main__":
    main()
