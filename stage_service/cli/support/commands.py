"""What every command shares: `--json`, help, errors that become sentences and exit codes."""

from __future__ import annotations

import argparse
import json
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stage_service.cli.support.output import Output

if TYPE_CHECKING:
    from stage_service.cli.support.client import ServiceClient

EXIT_CODES = {
    0: "done",
    1: "it ran and failed: a failed job or capture, a damaged capture, a fault of the program",
    2: "wrong usage",
    3: "bad input: a file, folder, rig, plan or name that cannot be used",
    4: "the service, the simulators or a device cannot be reached",
    130: "interrupted",
}
FAILED, BAD_INPUT, UNREACHABLE = 1, 3, 4

Commands = Any  # argparse does not export the type of what add_subparsers returns
Run = Callable[[argparse.Namespace, Output], int]
RemoteRun = Callable[[argparse.Namespace, Output, "ServiceClient"], int]


class CommandError(Exception):
    """Ends a command with `code`; the message is for the user, `more` goes into the JSON."""

    def __init__(self, message: str, code: int = FAILED, kind: str = "Failed", **more: Any) -> None:
        super().__init__(message)
        self.code, self.kind, self.more = code, kind, more


class BadArgument(CommandError):
    """The user gave something that cannot be used."""

    def __init__(self, message: str) -> None:
        super().__init__(message, BAD_INPUT, "BadInput")


class _Help(argparse.ArgumentDefaultsHelpFormatter):
    """Tells of the defaults that say something."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default is None or action.default is False or action.default == []:
            return action.help
        return super()._get_help_string(action)


def add_command(
    commands: Commands, name: str, run: Run, help: str, description: str | None = None
) -> argparse.ArgumentParser:
    """Add a command with what every command has: `--json`, help, the function that runs it."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=help, description=description or _sentence(help), formatter_class=_Help
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    parser.set_defaults(run=run)
    return parser


def add_remote(commands: Commands, name: str, run: RemoteRun, help: str) -> argparse.ArgumentParser:
    """Add a command that asks a running service."""

    def connected(args: argparse.Namespace, output: Output) -> int:
        from stage_service.cli.support.client import ServiceClient

        with ServiceClient(args.url, args.lease) as service:
            return run(args, output, service)

    parser = add_command(commands, name, connected, help)
    parser.add_argument("--url", help="the service's URL (also: HAIRSTAGE_URL)")
    parser.add_argument("--lease", help="token of the lease under which to steer")
    return parser


def add_group(commands: Commands, name: str, help: str) -> Commands:
    """Add a command that has commands of its own."""
    parser = commands.add_parser(name, help=help, description=_sentence(help))
    return parser.add_subparsers(dest="action", metavar="ACTION", required=True)


def _sentence(help: str) -> str:
    return help[0].upper() + help[1:] + "."


def add_held_out(parser: argparse.ArgumentParser) -> None:
    """Add `--hold-out-camera` and `--hold-out-light`."""
    for kind in ("camera", "light"):
        parser.add_argument(
            f"--hold-out-{kind}",
            action="append",
            default=[],
            metavar=kind.upper(),
            help=f"a {kind} to leave out, to judge the result on (repeat for more)",
        )


def rig_path(text: str) -> Path:
    """The path of a rig file, or of one that comes with hairstage where its name is given."""
    own = Path(__file__).parents[2] / "rigs" / f"{text}.toml"
    return own if own.is_file() else Path(text)


def read_json(text: str | Path | None) -> Any:
    """The JSON of an option: the text itself, or the file that it names; {} for None."""
    if text is None:
        return {}
    inline = str(text).lstrip().startswith("{")
    try:
        return json.loads(str(text) if inline else Path(text).read_text())
    except json.JSONDecodeError as error:
        raise BadArgument(f"{text} is not JSON: {error}") from error


def run_command(parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> int:
    """Run the command that `argv` names; returns its exit code (see `EXIT_CODES`)."""
    args = parser.parse_args(argv)
    output = Output(as_json=args.json)
    try:
        return args.run(args, output)
    except KeyboardInterrupt:
        output.error("Interrupted", "interrupted")
        return 130
    except BrokenPipeError:
        # whoever read the output has seen enough; keep the interpreter's last flush quiet, too
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except CommandError as error:
        output.error(error.kind, str(error), **error.more)
        return error.code
    except Exception as error:
        if isinstance(error, OSError | ValueError | LookupError) and _is_ours(error):
            output.error(type(error).__name__, _message(error))
            return BAD_INPUT
        from reconstruction.libllvm import BackendError

        if not isinstance(error, BackendError):
            traceback.print_exc(file=sys.stderr)
        output.error(type(error).__name__, str(error))
        return FAILED


def _is_ours(error: Exception) -> bool:
    """Whether a reader or a check of ours raised it about the user's input, not a library."""
    ours = {"reconstruction", "appearance", "stage_service", "benchmarks"}
    ours |= {"builtins", "pydantic_core"}
    return isinstance(error, OSError) or type(error).__module__.split(".")[0] in ours


def _message(error: Exception) -> str:
    """The error's sentence; a `KeyError` quotes it, pydantic makes paragraphs of it."""
    from pydantic import ValidationError

    from reconstruction.options import sentence

    if isinstance(error, ValidationError):
        return sentence(error)
    return str(error.args[0]) if isinstance(error, LookupError) and error.args else str(error)
