"""`hairstage lease`: exclusive control of a stage for some time."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from stage_service.cli.support.commands import Commands, Output, add_group
from stage_service.cli.support.remote import add_remote

if TYPE_CHECKING:
    from stage_service.cli.support.client import ServiceClient


def add(commands: Commands) -> None:
    """Add the commands."""
    lease = add_group(commands, "lease", "take, renew and release exclusive control of a stage")
    take = add_remote(lease, "take", run_take_lease)
    take.add_argument("--holder", help="name of the holder; default: this user and machine")
    take.add_argument("--seconds", type=float, default=600.0)
    add_remote(lease, "show", run_show_lease)
    renew = add_remote(lease, "renew", run_renew_lease)
    renew.add_argument("--seconds", type=float, default=600.0, help="from now")
    release = add_remote(lease, "release", run_release_lease)
    release.add_argument(
        "--force", action="store_true", help="end somebody else's lease; needs the scope admin"
    )


def run_take_lease(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Take the lease; prints its token."""
    from stage_service.cli.support.client import me

    granted = service.post("/lease", {"holder": args.holder or me(), "seconds": args.seconds})
    output.result(granted, granted["token"])


def run_show_lease(_args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Show the holder of the lease and its end."""
    held = service.get("/lease")
    text = (
        f"{held['holder']} until {held['expires']}" if held["holder"] else "nobody holds the lease"
    )
    output.result(held, text)


def run_renew_lease(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Extend the lease given by --lease."""
    granted = service.request("PATCH", "/lease", json={"seconds": args.seconds})
    output.result(granted, f"until {granted['expires']}")


def run_release_lease(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Release the lease given by --lease."""
    output.result(service.request("DELETE", f"/lease?force={args.force}"), "released")
