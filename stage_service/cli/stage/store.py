"""`hairstage store`: captures, models, trash and uploads of a running service."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from stage_service.cli.support.commands import (
    BadArgument,
    Commands,
    Output,
    add_group,
    in_url,
    progress_bar,
)
from stage_service.cli.support.remote import add_remote

if TYPE_CHECKING:
    from stage_service.cli.support.client import ServiceClient

KINDS = ("capture", "model")


def add(commands: Commands) -> None:
    """Add the commands."""
    store = add_group(commands, "store", "captures and models on a running service's disk")
    download = add_remote(store, "download", run_download)
    remove = add_remote(store, "remove", run_remove)
    for parser in (download, remove):
        parser.add_argument("kind", choices=KINDS)
        parser.add_argument("name", help="its id, or name")
    download.add_argument("--out", type=Path, help="file; default: NAME.tar")
    add_remote(store, "trash", run_trash)
    add_remote(store, "restore", run_restore).add_argument(
        "name", help="name in the trash, see 'trash'"
    )
    empty = add_remote(store, "empty", run_empty)
    empty.add_argument("--older-than-days", type=float, default=30.0)
    for parser in (remove, empty):
        parser.add_argument(
            "--dry-run", action="store_true", help="only list what would be removed"
        )
    upload = add_remote(store, "upload", run_upload)
    upload.add_argument("subject", help="name of the subject, for --upload of captures")
    upload.add_argument("--head", type=Path, help="the digitised head (.obj)")
    upload.add_argument("--masks", type=Path, help="folder of hair masks, <camera>.png")


def run_download(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Download all files of a capture or a model as a tar file.

    Resumes a broken download if no file has changed.
    """
    out = args.out or Path(f"{args.name}.tar")
    with progress_bar("download") as progress:
        size = service.download(f"/{args.kind}s/{in_url(args.name)}/archive.tar", out, progress)
    output.result({"file": str(out), "bytes": size}, f"{out}: {size:,} bytes")


def run_remove(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Move a capture or a model to the trash."""
    path = f"/{args.kind}s/{in_url(args.name)}?dry_run={args.dry_run}"
    found = service.request("DELETE", path)
    done = "would go into the trash" if args.dry_run else f"is in the trash as {found['name']}"
    stay = f"; its models stay: {', '.join(found['models'])}" if found["models"] else ""
    output.result(found, f"{args.kind} {args.name}, {found['bytes']:,} bytes, {done}{stay}")


def run_trash(_args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """List the trash."""
    _list(service.get("/trash"), output, "the trash is empty")


def run_restore(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Restore an entry of the trash; needs the scope admin."""
    found = service.post(f"/trash/{in_url(args.name)}/restore")
    output.result(found, f"{found['kind']} {found['id']} is restored")


def run_empty(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Delete old entries of the trash for good; needs the scope admin."""
    query = f"older_than_days={args.older_than_days}&dry_run={args.dry_run}"
    _list(service.request("DELETE", f"/trash?{query}"), output, "nothing is that old")


def run_upload(args: argparse.Namespace, output: Output, service: ServiceClient) -> None:
    """Upload a subject's head and masks, for captures that name it."""
    files = {} if args.head is None else {"head.obj": args.head}
    masks = sorted(args.masks.glob("*.png")) if args.masks is not None else []
    files |= {f"masks/{mask.name}": mask for mask in masks}
    if not files or (args.masks is not None and not masks):
        raise BadArgument("nothing to upload: give --head, or --masks with <camera>.png in it")
    stored: dict[str, Any] = {}
    for name, file in files.items():
        path = f"/uploads/{in_url(args.subject)}/{quote(name)}"
        stored = service.request("PUT", path, content=file.read_bytes())
    output.result(stored, f"{args.subject}: {', '.join(stored['files'])}")


def _list(found: list[dict[str, Any]], output: Output, nothing: str) -> None:
    lines = [
        f"{r['name']}  {r['kind']} {r['id']}  {r['bytes']:,} bytes  {r['removed']}  by {r['by']}"
        + (f"  a link to {r['link']}" if r["link"] else "")
        + (f"  cannot be restored: {r['problem']}" if r["problem"] else "")
        for r in found
    ]
    output.result({"trash": found}, "\n".join(lines) or nothing)
