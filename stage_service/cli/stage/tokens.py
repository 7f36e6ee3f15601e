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
    pages = add_command(token, "revoke-blackouts", run_revoke_blackouts)
    for parser in (make, listed, revoke, pages):
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
    _record(args, "token.make", args.name, ", ".join(scopes))
    output.result({"name": args.name, "scopes": scopes, "token": token}, token)


def run_list(args: argparse.Namespace, output: Output) -> None:
    """List the tokens: names, scopes, when they were made."""
    entries = [e.model_dump(exclude={"sha256"}) for e in _tokens(args).entries()]
    lines = [f"{e['name']}  {', '.join(e['scopes'])}  {e['made']}" for e in entries]
    output.result({"tokens": entries}, "\n".join(lines) or "no tokens")


def run_revoke(args: argparse.Namespace, output: Output) -> None:
    """End a token and its logins; counts at once in a running service.

    A page that has logged in by it can still black out, and do nothing else: darkness harms nobody.
    'hairstage token revoke-blackouts' ends that, for all pages.
    """
    _tokens(args).revoke(args.name)
    _record(args, "token.revoke", args.name)
    output.result({"revoked": args.name}, f"{args.name} has no token any more")


def run_revoke_blackouts(args: argparse.Namespace, output: Output) -> None:
    """End all blackout rights of pages, and all logins; people log in again.

    A page that has once logged in keeps the right to black out, and to nothing else, beyond its
    login's end and its token's. Replaces the key in ROOT/login.key; counts at once in a running
    service. Tokens stay.
    """
    from stage_service.records.signing import KEY_FILE, write_key

    file = args.root / KEY_FILE
    if not args.root.is_dir():
        raise BadArgument(f"--root {args.root}: there is no such folder")
    write_key(file)
    _record(args, "blackout.revoke", "service")
    output.result({"key": str(file)}, "all blackout rights and all logins have ended")


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


def _record(args: argparse.Namespace, action: str, subject: str, detail: str = "") -> None:
    from stage_service.cli.support.client import me
    from stage_service.records.audit import AuditLog

    AuditLog(args.root / "audit.jsonl").record(me(), action, subject, detail=detail)
