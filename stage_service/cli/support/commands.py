"""Shared by all commands: `--json`, help, output (results on stdout, progress on stderr), errors
and exit codes."""

from __future__ import annotations

import argparse
import contextlib
import inspect
import json
import math
import os
import platform
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import quote

from reconstruction import Progress
from reconstruction.reading import parse_json
from stage_service.signals import Terminated, terminable

EXIT_CODES = {
    0: "done",
    1: "it ran and failed: a failed job or capture, a damaged capture, a fault of the program",
    2: "wrong usage",
    3: "bad input: a file, folder, rig, plan or name that cannot be used",
    4: "the service, the simulators or a device cannot be reached",
    130: "interrupted by Ctrl-C",
    143: "terminated by SIGTERM",
}
FAILED, BAD_INPUT, UNREACHABLE = 1, 3, 4
PRIVATE = 0o027
"""umask of the stage's processes: frames show faces, so only user and group may read them."""
LINE_EVERY_S = 10.0
"""Seconds between progress lines in a log."""


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
        # a table in a file or a log has no window to fit
        width = None if self._stdout.isatty() else 120
        # names are printed as they are: ":x:" is no emoji
        console = Console(width=width, highlight=False, emoji=False, file=self._stdout)
        console.print(shown, markup=False, soft_wrap=True)

    def error(self, kind: str, detail: str, **more: Any) -> None:
        """Print an error on stderr, and with --json as the one object on stdout."""
        if self.as_json:
            data = {"error": {"type": kind, "detail": detail, **more}}
            print(json.dumps(data), file=self._stdout, flush=True)
        print(f"hairstage: {detail}", file=sys.stderr, flush=True)

    def note(self, text: str) -> None:
        """A line for people, on stderr."""
        print(text, file=sys.stderr, flush=True)


@contextlib.contextmanager
def progress_bar(title: str) -> Iterator[Progress]:
    """A `Progress` that draws a bar on stderr, or lines if stderr is no terminal."""
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
    printed, at = float("-inf"), 0.0

    def show(what: str, share: float) -> None:
        nonlocal printed, at
        now = time.monotonic()
        if now - printed >= LINE_EVERY_S or share >= 1 > at:
            per_cent = math.floor(100 * share)  # 100 is the end
            print(f"{title}: {per_cent:3d}% {what}", file=sys.stderr, flush=True)
            printed = now
        at = share

    return show


Commands = Any  # argparse does not export the return type of add_subparsers
Run = Callable[[argparse.Namespace, Output], int | None]


class CommandError(Exception):
    """Ends a command with `code`; the message is for the user, `more` goes into the JSON."""

    def __init__(self, message: str, code: int = FAILED, kind: str = "Failed", **more: Any) -> None:
        super().__init__(message)
        self.code, self.kind, self.more = code, kind, more


class BadArgument(CommandError):
    """An argument that cannot be used."""

    def __init__(self, message: str) -> None:
        super().__init__(message, BAD_INPUT, "BadInput")


class _Help(argparse.ArgumentDefaultsHelpFormatter):
    """Shows defaults, but for None, False and []."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default is None or action.default is False or action.default == []:
            return action.help
        return super()._get_help_string(action)


def add_command(
    commands: Commands,
    name: str,
    run: Callable[..., int | None],
    help: str | None = None,
    interrupted: str = "",
    renders: bool = False,
) -> argparse.ArgumentParser:
    """Add a command with `--json` and `--debug`, its help, and `run`, the function that runs it.

    The help is the docstring of `run`: its first sentence, and the rest as the description.
    `interrupted` says what remains of an interrupted run, and what the next one does. A command
    that `renders` has `--gpu`.
    """
    first, _, rest = (inspect.getdoc(run) or "").partition("\n\n")
    help = help or _phrase(first)
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=help, description=rest or _sentence(help), formatter_class=_Help
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    parser.add_argument("--debug", action="store_true", help="print the traceback of an error")
    if renders:
        text = "run on an NVIDIA GPU, as $HAIRSTAGE_VARIANT=cuda_ad_rgb does; without, on the CPU"
        parser.add_argument("--gpu", dest="on_gpu", action="store_true", help=text)
    parser.set_defaults(run=run, interrupted=interrupted)
    return parser


def add_group(commands: Commands, name: str, help: str) -> Commands:
    """Add a command with subcommands."""
    parser = commands.add_parser(name, help=help, description=_sentence(help))
    return parser.add_subparsers(dest="action", metavar="ACTION", required=True)


def _sentence(help: str) -> str:
    return help[0].upper() + help[1:] + "."


def _phrase(sentence: str) -> str:
    text = " ".join(sentence.removesuffix(".").split())
    return text if text[1:2].isupper() else text[0].lower() + text[1:]


def add_frame(parser: argparse.ArgumentParser) -> None:
    """Add `--frame`."""
    parser.add_argument(
        "--frame",
        choices=("user", "stage"),
        default="user",
        help="of an imported capture: that of the user's cameras (default), or the stage's",
    )


def add_view(parser: argparse.ArgumentParser) -> None:
    """Add the view of a capture: `--hold-out-camera`, `--hold-out-light`, `--reduce`."""
    for kind in ("camera", "light"):
        parser.add_argument(
            f"--hold-out-{kind}",
            action="append",
            default=[],
            metavar=kind.upper(),
            help=f"a {kind} to hold out and score the result on (repeat for more)",
        )
    parser.add_argument(
        "--reduce",
        type=int,
        default=1,
        metavar="N",
        help="work on means over N × N pixels, which takes a fraction of time and memory",
    )


def rig_path(text: str) -> Path:
    """The path of a rig file, given as a path or as the name of one that comes with hairstage."""
    own = Path(__file__).parents[2] / "rigs" / f"{text}.toml"
    return own if own.is_file() else Path(text)


def whole(least: int, most: int = 1_000_000) -> Callable[[str], int]:
    """A parser of an option's integer from `least` to `most`."""

    def number(text: str) -> int:
        if not least <= (value := int(text)) <= most:
            raise argparse.ArgumentTypeError(f"{value} is not from {least} to {most}")
        return value

    return number


def read_json(text: str | Path | None) -> dict[str, Any]:
    """The JSON object of an option, inline or in the file that it names; {} for None."""
    if text is None:
        return {}
    inline = str(text).lstrip().startswith("{")
    try:
        found = parse_json(str(text) if inline else Path(text).read_bytes())
    except FileNotFoundError as error:
        raise BadArgument(
            f"{text}: no such file; give a JSON object, '{{\"name\": value}}', or a file of one"
        ) from error
    except ValueError as error:
        raise BadArgument(f"{text} is not JSON: {error}") from error
    if not isinstance(found, dict):
        raise BadArgument(f"{text}: expected an object, {{...}}, got {type(found).__name__}")
    return found


def in_url(name: str) -> str:
    """A name as one segment of a URL's path, escaped."""
    return quote(name, safe="")


def run_command(parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> int:
    """Run the command that `argv` names; returns its exit code (see `EXIT_CODES`)."""
    given = sys.argv[1:] if argv is None else list(argv)
    for k in range(len(given) - 1):  # argparse takes "-y" for an option
        if given[k] == "--up" and given[k + 1] in ("-x", "-y", "-z"):
            given[k : k + 2] = [f"--up={given[k + 1]}"]
            break
    args = parser.parse_args(given)
    output = Output(as_json=args.json)
    debug = getattr(args, "debug", False)
    try:
        with terminable(), contextlib.redirect_stdout(sys.stderr):  # OpenEXR prints warnings
            if getattr(args, "on_gpu", False):
                _choose_gpu(output)
            return args.run(args, output) or 0
    except (KeyboardInterrupt, Terminated) as stop:
        what, code = ("terminated", 143) if isinstance(stop, Terminated) else ("interrupted", 130)
        remains = str(stop) or getattr(args, "interrupted", "")
        output.error("Interrupted", f"{what}: {remains}" if remains else what)
        return code
    except BrokenPipeError:
        # the reader has closed the pipe; the interpreter flushes once more at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        kind, code = type(error).__name__, FAILED
        if isinstance(error, CommandError):
            output.error(error.kind, str(error), **error.more)
            code = error.code
        elif isinstance(error, OSError | ValueError | LookupError) and _is_ours(error):
            output.error(kind, _message(error))
            code = BAD_INPUT
        elif kind == "BackendError":  # by name: its module may fail to import
            output.error(kind, str(error))
        else:
            where = "the traceback below" if debug else _stored_trace()
            output.error(kind, f"a fault of hairstage, report it with {where}: {kind}: {error}")
        if debug:
            traceback.print_exc(file=sys.stderr)
        return code


def _choose_gpu(output: Output) -> None:
    """Let this process and its children run on the GPU. Raises `BackendError` where none is."""
    from reconstruction.array_backend import VARIANT, chosen_variant

    os.environ[VARIANT] = "cuda_ad_rgb"
    output.note(f"running on the GPU ({chosen_variant()})")


def _stored_trace() -> str:
    """The file with versions and the traceback of the present exception; without a disk the text
    itself."""
    about = f"hairstage {version('hairstage')}, Python {sys.version}, {platform.platform()}"
    text = f"{about}\n\n{traceback.format_exc()}"
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="hairstage-error-", suffix=".txt", delete=False
        ) as file:
            file.write(text)
    except OSError:
        return f"this text:\n{text}"
    return file.name


def _is_ours(error: Exception) -> bool:
    """Whether our code raised it about the user's input, and not a library."""
    ours = {"reconstruction", "appearance", "stage_service", "benchmarks"}
    ours |= {"builtins", "pydantic_core"}
    return isinstance(error, OSError) or type(error).__module__.split(".")[0] in ours


def _message(error: Exception) -> str:
    """The error's sentence, without the quotes of `KeyError` and the paragraphs of pydantic."""
    from pydantic import ValidationError

    from reconstruction.options import sentence

    if isinstance(error, ValidationError):
        return sentence(error)
    return str(error.args[0]) if isinstance(error, LookupError) and error.args else str(error)
