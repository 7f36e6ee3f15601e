"""`hairstage serve`, `worker` and `simulate`: the processes of a stage."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import ssl
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from stage_service.cli.stage.tokens import TOKENS
from stage_service.cli.support.commands import (
    PRIVATE,
    UNREACHABLE,
    BadArgument,
    CommandError,
    Commands,
    Output,
    add_command,
    rig_path,
    whole,
)

if TYPE_CHECKING:
    from stage_service.api.gate import Access

DEFAULT_PORT = 8331
RIG_HELP = "rig file, or one that comes with hairstage: demo, stage331"


def add(commands: Commands) -> None:
    """Add the commands."""
    serve = add_command(commands, "serve", run_serve)
    serve.add_argument("--rig", type=rig_path, required=True, help=RIG_HELP)
    serve.add_argument("--devices", type=Path, help="file whose [devices] overrides the rig file's")
    serve.add_argument(
        "--root", type=Path, default=Path("runs/stage"), help="folder of captures and models"
    )
    serve.add_argument(
        "--port", type=whole(0, 65535), default=DEFAULT_PORT, help="0 takes any free port"
    )
    serve.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen on; other than this machine's needs TLS",
    )
    serve.add_argument(
        "--socket", type=Path, help="Unix socket instead of a port, for user and group"
    )
    serve.add_argument("--tls-cert", type=Path, help="certificate chain, PEM")
    serve.add_argument("--tls-key", type=Path, help="private key, if not in the certificate's file")
    serve.add_argument(
        "--name", action="append", default=[], help="a further host name of this service"
    )
    serve.add_argument(
        "--root-path", default="", help="path under which a proxy serves it, such as /stage"
    )
    serve.add_argument(
        "--take-over", action="store_true", help="take the stage from a service that has died"
    )
    serve.add_argument(
        "--no-auth", action="store_true", help="grant all scopes to everybody on this machine"
    )
    serve.add_argument(
        "--gpu-workers", action="store_true", help="queue rendering jobs for a 'worker --gpu'"
    )

    worker = add_command(commands, "worker", run_worker)
    worker.add_argument(
        "--root", type=Path, default=Path("runs/stage"), help="the service's root folder"
    )
    worker.add_argument("--concurrency", type=whole(1), default=1, help="jobs at the same time")
    worker.add_argument(
        "--gpu",
        action="store_true",
        help="run the jobs that 'serve --gpu-workers' queues for a GPU",
    )
    worker.add_argument(
        "--take-over",
        metavar="HOST",
        help="take over the jobs of a machine whose workers have died",
    )

    for process in (serve, worker):
        process.add_argument("--log-json", action="store_true", help="log one JSON object a line")

    simulate = add_command(commands, "simulate", run_simulate)
    add_subject(simulate)
    simulate.add_argument("--state", type=Path, default=Path("runs/simulated"), help="state folder")
    simulate.add_argument("--truth", type=Path, help="folder for the true strands and appearance")
    simulate.add_argument("--faults", type=Path, help="JSON list of faults to inject")
    simulate.add_argument("--spp", type=int, help="paths a pixel of frames (default: 16)")
    simulate.add_argument(
        "--ports", choices=("auto", "rig"), default="auto", help="free TCP ports, or the rig file's"
    )


def run_serve(args: argparse.Namespace, output: Output) -> None:
    """Run the service: devices, captures and the HTTP API.

    Run the service for one rig on 127.0.0.1. SIGTERM and Ctrl-C put the lights off first. With
    --json, one object with the URL is printed when the service is ready. Requests need a token: the
    commands send this user's, which is created on first use; 'hairstage token' makes others.
    """
    log_to_stderr(args.log_json)
    from stage_service.api.app import Endpoint, serve
    from stage_service.api.prefix import checked
    from stage_service.captures.stage import put_off
    from stage_service.config import load_rig_file
    from stage_service.devices.ownership import StageInUse
    from stage_service.records.lease import RootInUse
    from stage_service.service import Service

    exit_on_sigterm()
    os.umask(PRIVATE)
    endpoint = Endpoint(args.host.strip("[]"), args.port, args.socket, args.tls_cert, args.tls_key)
    if not endpoint.local and (args.no_auth or args.tls_cert is None):
        raise BadArgument(
            f"--host {args.host}: requests from other machines need tokens and TLS: "
            "leave out --no-auth, and give --tls-cert and --tls-key"
        )
    _check_certificate(args)
    args.root_path = checked(args.root_path)
    rig_file = load_rig_file(args.rig, args.devices)
    try:
        service = Service(
            rig_file,
            args.root,
            take_over=args.take_over,
            gpu_workers=args.gpu_workers,
        )
        service.take_stage()
    except StageInUse as error:
        raise CommandError(str(error), UNREACHABLE, "StageInUse") from error
    except RootInUse:
        raise
    except OSError as error:  # e.g. a read-only disk: lamps may still be on
        off = put_off(rig_file, args.root, take_over=args.take_over)
        raise CommandError(
            f"--root {args.root}: {error}: choose another folder, or make this one writable. No "
            "service "
            f"runs; lamps and projectors were commanded off: {off}"
        ) from error

    access = _access(args, {endpoint.name, *args.name}, output)

    def ready(url: str) -> None:
        text = f"serving {service.rig_file.rig.name} at {url} (API: {url}/docs)"
        output.result({"url": url, "root": str(args.root), "rig": str(args.rig)}, text)

    service.decoder.warm_up()
    serve(service, endpoint, access, ready)


def _check_certificate(args: argparse.Namespace) -> None:
    """Raise `BadArgument` for a certificate that cannot be used, before a device is opened."""
    if args.tls_cert is None:
        if args.tls_key is not None:
            raise BadArgument("--tls-key needs --tls-cert")
        return
    for file in filter(None, (args.tls_cert, args.tls_key)):
        if not file.is_file():
            raise BadArgument(f"{file}: no such file")
    try:
        ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(
            args.tls_cert, args.tls_key
        )
    except OSError as error:
        raise BadArgument(
            f"--tls-cert {args.tls_cert}: not a certificate with its key: {error}"
        ) from error


def _access(args: argparse.Namespace, named: set[str], output: Output) -> Access:
    from stage_service.api.gate import OWN_NAMES, Access
    from stage_service.records.logins import Logins
    from stage_service.records.tokens import Tokens, own_file, own_token

    names = OWN_NAMES | {name.lower() for name in named}
    if args.no_auth:
        output.note("no tokens are required: everybody on this machine has all scopes")
        return Access(None, names, prefix=args.root_path)
    try:
        own = own_token()
        output.note(f"requests need a token; yours is in {own_file()} (hairstage token show)")
    except OSError as error:
        own = None
        output.note(
            f"no token of yours can be stored here ({error}): make one with 'hairstage token make'"
        )
    return Access(Tokens(args.root / TOKENS, own), names, Logins(args.root), prefix=args.root_path)


def run_worker(args: argparse.Namespace, output: Output) -> None:
    """Run a worker, which takes jobs off the queue.

    Run the jobs of one root folder. If a worker dies, another worker of this machine resumes its
    job at the interrupted step. Workers on several machines mount the root and share a PostgreSQL
    database, $HAIRSTAGE_DATABASE_URL.
    """
    log_to_stderr(args.log_json)
    from reconstruction.array_backend import VARIANT, prefer_cuda
    from stage_service.jobs.worker import run_worker as work

    if args.gpu and not prefer_cuda():
        chosen = os.environ.get(VARIANT)
        why = f"${VARIANT} is {chosen}" if chosen else "no CUDA device is found"
        output.note(f"jobs render on the CPU: {why}")
    os.umask(PRIVATE)
    args.root.mkdir(parents=True, exist_ok=True)
    work(
        args.root,
        concurrency=args.concurrency,
        gpu=args.gpu,
        take_over=args.take_over,
        ready=lambda name: output.result(
            {"worker": name, "root": str(args.root)}, f"{name} runs the jobs of {args.root}"
        ),
    )


def run_simulate(args: argparse.Namespace, output: Output) -> int:
    """Run a simulated rig with the wire protocols of a real one.

    When the devices are ready, STATE/devices.toml is written for 'hairstage serve --devices'. To
    calibrate, SUBJECT is board:N, mirror:N or diffuse:N, in pose or place N.
    """
    from stage_service.cli.support.children import Children, SimulatedRig

    exit_on_sigterm()
    more = ["--state", args.state, "--ports", args.ports]
    for option in ("truth", "faults", "spp"):
        if getattr(args, option) is not None:
            more += [f"--{option}", str(getattr(args, option))]
    simulated = SimulatedRig(args.rig, args.subject, args.head, args.seed)
    with Children(args.state / "logs") as children:
        child = children.start("simulators", simulated.command(*more), to_log=False, pipe=True)
        devices = children.first_line("simulators", child, 600)["devices"]
        output.result({"devices": devices}, f"the simulated rig is ready; its devices: {devices}")
        while (code := child.poll()) is None:  # short: a signal may come just before it
            time.sleep(0.2)
        return 0 if code in (0, -signal.SIGINT, -signal.SIGTERM) else 1


_GROOMS = "wavy", "straight", "curly", "coils"
SUBJECTS = (*_GROOMS, *(f"{name}-mixed" for name in _GROOMS), "dressed")
"""The simulators' subjects; a mixed one has the strands of its groom in several colours, a dressed
one a beard, clothes and a hand."""


def add_subject(parser: argparse.ArgumentParser) -> None:
    """Add the options of rig and subject."""
    parser.add_argument("--rig", type=rig_path, default="demo", help=RIG_HELP)
    names = ", ".join(SUBJECTS)
    parser.add_argument("--subject", default="wavy-mixed", help=f"{names} or a strand file")
    parser.add_argument("--head", type=Path, help="head mesh (.obj) for a strand file")
    parser.add_argument("--seed", type=int, default=0)


def exit_on_sigterm() -> None:
    """Make SIGTERM, the usual end of a service, end the process with code 0; SIGHUP too, unless it
    is ignored."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: sys.exit(0))


def log_to_stderr(as_json: bool = False) -> None:
    """Log to stderr from level INFO; repeated connection errors of the job database are counted."""
    from stage_service.jobs.queue import LIBRARIES
    from stage_service.records.logs import JsonLines

    handler = logging.StreamHandler(sys.stderr)
    handler.addFilter(LIBRARIES)
    plain = logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s")
    handler.setFormatter(JsonLines() if as_json else plain)
    logging.basicConfig(level=logging.INFO, handlers=[handler])
