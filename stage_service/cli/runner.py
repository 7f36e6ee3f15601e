"""Runs one command of a parser: errors become sentences and exit codes."""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from collections.abc import Sequence

from stage_service.cli.output import BAD_INPUT, FAILED, CommandError, Output


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
        traceback.print_exc(file=sys.stderr)
        output.error(type(error).__name__, str(error))
        return FAILED


def _is_ours(error: Exception) -> bool:
    """Whether a reader or a check of ours raised it about the user's input, not a library."""
    ours = {"reconstruction", "appearance", "stage_service", "benchmarks"}
    ours |= {"builtins", "pydantic_core"}
    return isinstance(error, OSError) or type(error).__module__.split(".")[0] in ours


def _message(error: Exception) -> str:
    """The error's sentence; a `KeyError` quotes it, which nobody wants to read."""
    return str(error.args[0]) if isinstance(error, LookupError) and error.args else str(error)
