"""The command line: parse, call one function, write. Everything heavy is imported inside the commands."""

import sys
from collections.abc import Sequence
from typing import Annotated

import typer

# Imported for the commands that they add, in the order of the help.
from jaxsat.cli import estimate, orientation, periodic, sweep, simulate  # noqa: F401 isort: skip
from jaxsat.cli.shared import app
from jaxsat.errors import InputError

# What typer raises for wrong arguments; where it lives changed between versions.
_UsageError: type[Exception] = typer.BadParameter.__bases__[0]


@app.callback(invoke_without_command=True)
def root(version: Annotated[bool, typer.Option("--version", help="print the version")] = False) -> None:
    if version:
        import jaxsat

        typer.echo(f"jaxsat {jaxsat.__version__}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns its exit code. Bad arguments and input become one line on stderr."""
    try:
        given = sys.argv[1:] if arguments is None else arguments
        return app(args=list(given) or ["--help"], standalone_mode=False) or 0
    except InputError as error:
        message = str(error)
    except _UsageError as error:
        message = f"{error.format_message()} (see jaxsat --help)"  # type: ignore[attr-defined]
    except typer.Abort:
        return 130
    print("jaxsat:", " ".join(message.split()), file=sys.stderr)
    return 2
