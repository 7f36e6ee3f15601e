"""What every command shares: `--json`, help, what it prints (results on stdout, progress on
stderr), errors that become sentences and exit codes."""

from __future__ import annotations

import argparse
import contextlib
import inspect
import json
import math
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from reconstruction import Progress
from reconstruction.reading import parse_json

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
PRIVATE = 0o027
"""Frames are people's faces: what a stage writes is for its user, and to be read by its group."""
LINE_EVERY_S = 10.0
"""Where progress goes to a log, a line so often."""


class Output:
    """Prints one JSON object on stdout, or text for people."""

    def __init__(self, as_json: bool) -> None:
        self.as_json, self._stdout = as_json, sys.stdout

    def result(self, data: dict[str, Any], text: Any = None) -> None:
        """Print a command's result: `data` as JSON, or `text` (a string or a rich renderable)."""
        if self.as_json:
            print(json.dumps(data, allow_nan=False), file=self._stdout, flush=True)
            return
        from rich.console import Console

        shown = json.dumps(data, indent=1, allow_nan=False) if text is None else text
        # A table in a file or a log has no window to fit.
        width = None if self._stdout.isatty() else 120
        # names are printed as they are: ":x:" is part of one, and no picture
        console = Console(width=width, highlight=False, emoji=False, file=self._stdout)
        console.print(shown, markup=False, soft_wrap=True)

    def error(self, kind: str, detail: str, **more: Any) -> None:
        """Say what went wrong: on stderr, and with --json as the one object on stdout too."""
        if self.as_json:
            said = {"error": {"type": kind, "detail": detail, **more}}
            print(json.dumps(said), file=self._stdout, flush=True)
        print(f"hairstage: {detail}", file=sys.stderr, flush=True)

    def note(self, text: str) -> None:
        """A line for people, on stderr."""
        print(text, file=sys.stderr, flush=True)


@contextlib.contextmanager
def progress_bar(title: str) -> Iterator[Progress]:
    """A `Progress` that draws a bar on stderr; no terminal there: now and then a line."""
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(title)
        return
    with Bars(
        TextColumn("{task.fields[title]:<12}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
        console=console,
    ) as bars:
        task = bars.add_task("", total=1.0, title=title)

        def show(what: str, share: float) -> None:
            bars.update(task, description=what, completed=share)

        yield show


def _lines(title: str) -> Progress:
    told, at = float("-inf"), 0.0

    def show(what: str, share: float) -> None:
        nonlocal told, at
        now = time.monotonic()
        if now - told >= LINE_EVERY_S or share >= 1 > at:
            per_cent = math.floor(100 * share)  # 100 is the end
            print(f"{title}: {per_cent:3d}% {what}", file=sys.stderr, flush=True)
            told = now
        at = share

    return show


Commands = Any  # argparse does not export the type of what add_subparsers returns
Run = Callable[[argparse.Namespace, Output], int | None]
RemoteRun = Callable[[argparse.Namespace, Output, "ServiceClient"], int | None]


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
    commands: Commands, name: str, run: Run | RemoteRun, help: str | None = None
) -> argparse.ArgumentParser:
    """Add a command with what every command has: `--json`, help, the function that runs it.

    The help is that function's docstring: its first sentence, and what follows as the description.
    """
    first, _, rest = (inspect.getdoc(run) or "").partition("\n\n")
    help = help or _phrase(first)
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=help, description=rest or _sentence(help), formatter_class=_Help
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    parser.set_defaults(run=run)
    return parser


def add_remote(
    commands: Commands, name: str, run: RemoteRun, help: str | None = None
) -> argparse.ArgumentParser:
    """Add a command that asks a running service."""

    def connected(args: argparse.Namespace, output: Output) -> int | None:
        from stage_service.cli.support.client import ServiceClient

        with ServiceClient(args.url, args.lease) as service:
            return run(args, output, service)

    parser = add_command(commands, name, run, help)
    parser.set_defaults(run=connected)
    parser.add_argument("--url", help="the service's URL (also: HAIRSTAGE_URL)")
    parser.add_argument("--lease", help="token of the lease under which to steer")
    return parser


def add_group(commands: Commands, name: str, help: str) -> Commands:
    """Add a command that has commands of its own."""
    parser = commands.add_parser(name, help=help, description=_sentence(help))
    return parser.add_subparsers(dest="action", metavar="ACTION", required=True)


def _sentence(help: str) -> str:
    return help[0].upper() + help[1:] + "."


def _phrase(sentence: str) -> str:
    text = " ".join(sentence.removesuffix(".").split())
    return text if text[1:2].isupper() else text[0].lower() + text[1:]


def add_view(parser: argparse.ArgumentParser) -> None:
    """Add what of a capture is seen: `--hold-out-camera`, `--hold-out-light`, `--reduce`."""
    for kind in ("camera", "light"):
        parser.add_argument(
            f"--hold-out-{kind}",
            action="append",
            default=[],
            metavar=kind.upper(),
            help=f"a {kind} to leave out, to judge the result on (repeat for more)",
        )
    parser.add_argument(
        "--reduce",
        type=int,
        default=1,
        metavar="N",
        help="work on means over N × N pixels: large pictures need a fraction of time and memory",
    )


def rig_path(text: str) -> Path:
    """The path of a rig file, or of one that comes with hairstage where its name is given."""
    own = Path(__file__).parents[2] / "rigs" / f"{text}.toml"
    return own if own.is_file() else Path(text)


def whole(least: int, most: int = 1_000_000) -> Callable[[str], int]:
    """What reads an option's whole number from `least` to `most`."""

    def number(text: str) -> int:
        if not least <= (value := int(text)) <= most:
            raise argparse.ArgumentTypeError(f"{value} is not from {least} to {most}")
        return value

    return number


def read_json(text: str | Path | None) -> dict[str, Any]:
    """The JSON object of an option: the text itself, or the file that it names; {} for None."""
    if text is None:
        return {}
    inline = str(text).lstrip().startswith("{")
    try:
        found = parse_json(str(text) if inline else Path(text).read_bytes())
    except ValueError as error:
        raise BadArgument(f"{text} is not JSON: {error}") from error
    if not isinstance(found, dict):
        raise BadArgument(f"{text}: expected an object, {{...}}, got {type(found).__name__}")
    return found


def in_url(name: str) -> str:
    """A name as one part of a URL's path, in which `#`, `?`, `%` and `/` say something else."""
    return quote(name, safe="")


def run_command(parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> int:
    """Run the command that `argv` names; returns its exit code (see `EXIT_CODES`)."""
    args = parser.parse_args(argv)
    output = Output(as_json=args.json)
    try:
        with contextlib.redirect_stdout(sys.stderr):  # OpenEXR's warnings do not belong to a result
            return args.run(args, output) or 0
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
        if type(error).__name__ != "BackendError":  # its module may be what cannot be imported
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
