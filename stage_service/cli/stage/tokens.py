"""`hairstage token`: tokens of a service and their scopes."""

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
    make.add_argument("name", help="name of the owner, for the audit log")
    make.add_argument(
        "--scopes",
        default="read",
        help="from read, steer, arm, jobs, admin, separated by commas; or all",
    )
    listed = add_command(token, "list", run_list)
    revoke = add_command(token, "revoke", run_revoke)
    revoke.add_argument("name")
    pages = add_command(token, "revoke-blackouts", run_revoke_blackouts)
    for parser in (make, listed, revoke, pages):
        parser.add_argument("--root", type=Path, default=Path("runs/stage"), help="the service's")
    add_command(token, "show", run_show)


def run_make(args: argparse.Namespace, output: Output) -> None:
    """Make a token; it is printed only once.

    read: view captures, frames, jobs, devices, audit. steer: start, pause, resume and queue
    captures, hold the lease. arm: take responsibility for flashes, acknowledge dark lamps. jobs:
    submit and cancel. admin: remove completed captures, end others' leases. Abort and blackout need
    no scope.
    """
    from stage_service.records.tokens import SCOPES

    requested = set(SCOPES) if args.scopes == "all" else set(args.scopes.split(","))
    scopes = tuple(s for s in SCOPES if s in requested)
    if unknown := requested - set(SCOPES):
        raise BadArgument(f"--scopes: unknown {sorted(unknown)}; expected {', '.join(SCOPES)}")
    args.root.mkdir(mode=0o750, parents=True, exist_ok=True)
    token = _tokens(args).make(args.name, scopes)
    _record(args, "token.make", args.name, ", ".join(scopes))
    output.result({"name": args.name, "scopes": scopes, "token": token}, token)


def run_list(args: argparse.Namespace, output: Output) -> None:
    """List the tokens: names, scopes, dates."""
    entries = [e.model_dump(exclude={"sha256"}) for e in _tokens(args).entries()]
    lines = [f"{e['name']}  {', '.join(e['scopes'])}  {e['made']}" for e in entries]
    output.result({"tokens": entries}, "\n".join(lines) or "no tokens")


def run_revoke(args: argparse.Namespace, output: Output) -> None:
    """Revoke a token and its logins; takes effect at once in a running service.

    A page that was logged in with it can still send a blackout and nothing else.
    'hairstage token revoke-blackouts' ends that for all pages.
    """
    _tokens(args).revoke(args.name)
    _record(args, "token.revoke", args.name)
    output.result({"revoked": args.name}, f"the token of {args.name} is revoked")


def run_revoke_blackouts(args: argparse.Namespace, output: Output) -> None:
    """Revoke all blackout rights of pages, and all logins.

    A page that has logged in once may send a blackout, and nothing else, after its login or token
    has ended. Replaces the key in ROOT/login.key; takes effect at once in a running service. Tokens
    stay valid.
    """
    from stage_service.records.signing import KEY_FILE, write_key

    file = args.root / KEY_FILE
    if not args.root.is_dir():
        raise BadArgument(f"--root {args.root}: no such folder")
    write_key(file)
    _record(args, "blackout.revoke", "service")
    output.result({"key": str(file)}, "all blackout rights and all logins have ended")


def run_show(_args: argparse.Namespace, output: Output) -> None:
    """Print this user's token.

    It has all scopes at a service that this user runs on this machine. Commands send it
    automatically; use it for curl. It is stored in $HAIRSTAGE_TOKEN_FILE, else in
    ~/.config/hairstage/token; to replace it, remove that file and restart the service.
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
