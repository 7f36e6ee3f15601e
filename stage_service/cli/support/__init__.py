"""What the commands are made of; each command is in the file that has its name."""

from stage_service.cli.support.commands import (
    BAD_INPUT,
    EXIT_CODES,
    FAILED,
    UNREACHABLE,
    BadArgument,
    CommandError,
    Commands,
    add_command,
    add_group,
    add_held_out,
    add_remote,
    read_json,
    rig_path,
    run_command,
)
from stage_service.cli.support.output import Output, progress_bar

__all__ = [
    "BAD_INPUT",
    "EXIT_CODES",
    "FAILED",
    "UNREACHABLE",
    "BadArgument",
    "CommandError",
    "Commands",
    "Output",
    "add_command",
    "add_group",
    "add_held_out",
    "add_remote",
    "progress_bar",
    "read_json",
    "rig_path",
    "run_command",
]
