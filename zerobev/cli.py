"""The command `zerobev`, also `python -m zerobev`: one subcommand per job, one module per subcommand.

Such a module has `add_arguments(parser)` and `run(options)`; its docstring, the help text, states the command's inputs
and outputs. It is imported only when its command is called.
"""

import argparse
import sys
from importlib import import_module
from typing import Any

from zerobev.common.errors import run_command

#: Command -> module and line of help.
COMMANDS = {
    "project": ("zerobev.inference.project", "masks, labels or boxes of your image, on a map"),
    "export": ("zerobev.inference.export", "a network as an ONNX file, for programs without torch"),
    "evaluate": ("zerobev.evaluation.real_homes", "the shipped weights on a folder of homes"),
    "homes": ("zerobev.scenes.homes", "write generated homes"),
    "generate": ("zerobev.data.generate", "record scenes as shards of views"),
    "run": ("zerobev.experiments.launch", "compute one row of a table"),
    "reproduce": ("zerobev.report.notebooks", "run the workbook"),
    "summary": ("zerobev.report.page", "all tables, verdicts and figures on one page"),
    "spot-check": ("zerobev.experiments.spot_check", "compute one recorded run again and compare"),
    "plan": ("zerobev.benchmarks.forecast", "forecast of time, memory and disk"),
    "benchmark": ("zerobev.benchmarks.run", "cost of data, training and inference"),
    "parameters": ("zerobev.report.parameters", "parameters of every network"),
    "release": ("zerobev.experiments.release", "make the shipped weights"),
}


def main(arguments: list[str] | None = None) -> None:
    """Run a subcommand; bad input ends with one line on stderr and exit code 1.

    arguments: of the command line; default: of this process
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    lines = "\n".join(f"  {name:<12}{text}" for name, (_, text) in COMMANDS.items())
    parser = argparse.ArgumentParser(
        prog="zerobev",
        description="Zero-shot projection of any first-person modality to a bird's-eye-view map.",
        epilog=f"commands:\n{lines}\n\n`zerobev COMMAND --help` lists the inputs and outputs of a command.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND")
    chosen = parser.parse_args(arguments[:1]).command
    module = _module(chosen)
    own = argparse.ArgumentParser(
        prog=f"zerobev {chosen}", description=module.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    module.add_arguments(own)
    options = own.parse_args(arguments[1:])
    run_command(lambda: module.run(options))


def _module(command: str) -> Any:
    try:
        return import_module(COMMANDS[command][0])
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] == "zerobev":
            raise
        needed = f"install zerobev[{'export' if command == 'export' else 'scenes,workbook'}]"
        sys.exit(f"error: `zerobev {command}` needs the package {error.name}, which is not installed: {needed}")
