"""The command line: parse, call one function, write. Everything heavy is imported inside the commands."""

import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from jaxsat.cli.estimate import estimate_command, inspect_command
from jaxsat.cli.orientation import orientation_command
from jaxsat.cli.periodic import periodic_command
from jaxsat.cli.simulate import demo_command, simulate_command
from jaxsat.cli.sweep import sweep_command
from jaxsat.cli.tune import tune_command
from jaxsat.errors import InputError

# What typer raises for wrong arguments; where it lives changed between versions.
_UsageError: type[Exception] = typer.BadParameter.__bases__[0]

app = typer.Typer(
    name="jaxsat",
    help="Trajectories from inertial recordings that saturated.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for _name, _command in (
    ("inspect", inspect_command),
    ("estimate", estimate_command),
    ("orientation", orientation_command),
    ("periodic", periodic_command),
    ("sweep", sweep_command),
    ("tune", tune_command),
    ("simulate", simulate_command),
    ("demo", demo_command),
):
    app.command(_name)(_command)


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
