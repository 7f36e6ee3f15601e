"""`hairstage token`: who may do what on a service."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from stage_service.cli.support.commands import (
    BadArgument,
    Commands,
    Output,
    add_command,
    add_group,
)

if TYPE_CHECKING:
    from stage_service.records.tokens import Tokens

TOKENS = "tokens.json"


def add(commands: Commands) -> None:
    """Add the commands."""
    token = add_group(commands, "token", "make, list and revoke the tokens of a service")
    make = add_command(token, "make", run_make)
    make.add_argument("name", help="whose it is, as the audit will have it")
    make.add_argument(
        "--scopes", default="read", help="of read, steer, arm, jobs, admin, by commas; or all"
    )
    listed = add_command(token, "list", run_list)
    revoke = add_command(token, "revoke", run_revoke)
    revoke.add_argument("name")
    for parser in (make, listed, revoke):
        parser.add_argument("--root", type=Path, default=Path("runs/stage"), help="the service's")
    add_command(token, "show", run_show)


def run_make(args: argparse.Namespace, output: Output) -> None:
    """Make a token; prints it, this once.

    read: see captures, frames, jobs, devices, audit. steer: start, pause, resume and queue
    captures, hold the lease. arm: answer for flashes and acknowledge dark lamps. jobs: submit and
    cancel. admin: remove what completed, end somebody else's lease. Abort and blackout need none.
    """
    from stage_service.records.tokens import SCOPES

    asked = set(SCOPES) if args.scopes == "all" else set(args.scopes.split(","))
    scopes = tuple(s for s in SCOPES if s in asked)
    if unknown := asked - set(SCOPES):
        raise BadArgument(f"--scopes: there is no {sorted(unknown)}; there are {', '.join(SCOPES)}")
    args.root.mkdir(mode=0o750, parents=True, exist_ok=True)
    token = _tokens(args).make(args.name, scopes)
    _record(args, "token.make", ", ".join(scopes))
    output.result({"name": args.name, "scopes": scopes, "token": token}, token)


def run_list(args: argparse.Namespace, output: Output) -> None:
    """List the tokens: names, scopes, when they were made."""
    entries = [e.model_dump(exclude={"sha256"}) for e in _tokens(args).entries()]
    lines = [f"{e['name']}  {', '.join(e['scopes'])}  {e['made']}" for e in entries]
    output.result({"tokens": entries}, "\n".join(lines) or "no tokens")


def run_revoke(args: argparse.Namespace, output: Output) -> None:
    """End a token; a running service knows at once."""
    _tokens(args).revoke(args.name)
    _record(args, "token.revoke", "")
    output.result({"revoked": args.name}, f"{args.name} has no token any more")


def run_show(_args: argparse.Namespace, output: Output) -> None:
    """Print this user's own token.

    A service that this user runs on this machine takes it for everything, and the commands send it
    by themselves; so it is for curl. It lies in $HAIRSTAGE_TOKEN_FILE, else in
    ~/.config/hairstage/token; remove that file and restart the service to have another.
    """
    from stage_service.records.tokens import own_token

    token = own_token()
    output.result({"token": token}, token)


def _tokens(args: argparse.Namespace) -> Tokens:
    from stage_service.records.tokens import Tokens

    return Tokens(args.root / TOKENS)


def _record(args: argparse.Namespace, action: str, detail: str) -> None:
    from stage_service.cli.support.client import me
    from stage_service.records.audit import AuditLog

    AuditLog(args.root / "audit.jsonl").record(me(), action, args.name, detail=detail)
