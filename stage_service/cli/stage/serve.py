"""`hairstage serve`: the service of one stage."""

from __future__ import annotations

import argparse
from pathlib import Path

from stage_service.cli.support import Commands, Output, add_command, rig_path
from stage_service.cli.support.processes import RIG_HELP, exit_on_sigterm, log_to_stderr

DEFAULT_PORT = 8331


def add(commands: Commands) -> None:
    """Add the command."""
    serve = add_command(
        commands,
        "serve",
        run_serve,
        "run the service: devices, captures and the HTTP API",
        "Run the service for one rig on 127.0.0.1. SIGTERM and Ctrl-C put the lights off first. "
        "With --json, one object with the URL is printed when requests are answered.",
    )
    serve.add_argument("--rig", type=rig_path, required=True, help=RIG_HELP)
    serve.add_argument("--devices", type=Path, help="file whose [devices] wins over the rig file's")
    serve.add_argument("--root", type=Path, default=Path("runs/stage"), help="captures and models")
    serve.add_argument("--port", type=int, default=DEFAULT_PORT, help="0 takes any free port")


def run_serve(args: argparse.Namespace, output: Output) -> int:
    """Serve until a signal."""
    log_to_stderr()
    from stage_service.api.app import serve
    from stage_service.config import load_rig_file
    from stage_service.service import Service

    exit_on_sigterm()
    service = Service(load_rig_file(args.rig, args.devices), args.root)

    def ready(url: str) -> None:
        text = f"serving {service.rig_file.rig.name} at {url} (API: {url}/docs)"
        output.result({"url": url, "root": str(args.root), "rig": str(args.rig)}, text)

    serve(service, args.port, ready)
    return 0
