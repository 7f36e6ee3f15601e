"""Commands that send requests to a running service."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from stage_service.cli.support.commands import Commands, Output, add_command

if TYPE_CHECKING:
    from stage_service.cli.support.client import ServiceClient

RemoteRun = Callable[[argparse.Namespace, Output, "ServiceClient"], int | None]


def add_remote(
    commands: Commands, name: str, run: RemoteRun, help: str | None = None
) -> argparse.ArgumentParser:
    """Add a command that calls `run` with a `ServiceClient`."""

    def connected(args: argparse.Namespace, output: Output) -> int | None:
        from stage_service.cli.support.client import ServiceClient

        with ServiceClient(args.url, args.lease) as service:
            return run(args, output, service)

    parser = add_command(commands, name, run, help)
    parser.set_defaults(run=connected)
    parser.add_argument("--url", help="the service's URL (also: HAIRSTAGE_URL)")
    parser.add_argument("--lease", help="token of the lease under which to steer")
    return parser
