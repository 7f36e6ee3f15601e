"""`hairstage view`: a model in a browser."""

from __future__ import annotations

import argparse
from pathlib import Path
from urllib.parse import quote

from stage_service.cli.support.commands import (
    BadArgument,
    Commands,
    Output,
    add_command,
    add_frame,
)


def add(commands: Commands) -> None:
    """Add the command."""
    view = add_command(commands, "view", run)
    view.add_argument("model", type=Path)
    view.add_argument("--capture", type=Path, help="the model's capture")
    view.add_argument(
        "--truth", type=Path, help="a strand file to compare the model's strands with"
    )
    add_frame(view)
    view.add_argument("--port", type=int, default=0, help="0 takes any free port")


def run(args: argparse.Namespace, output: Output) -> None:
    """View a model in a browser.

    Serve MODEL to a browser on this machine until Ctrl-C: strands by direction, confidence, root,
    length or lit; with --capture its cameras and frames, and relighting by sums of OLAT frames. The
    printed address contains a key: anyone who has it can view the model.
    """
    import secrets
    import threading

    from reconstruction import Capture, Model, read_strands
    from stage_service.api.app import serve_viewer
    from stage_service.api.gate import Access
    from stage_service.cli.stage.processes import exit_on_sigterm
    from stage_service.decoding import Decoder
    from stage_service.records.tokens import Tokens
    from stage_service.viewer import Viewed, Viewing

    model = Model(args.model)
    if not model.has("strands.npz"):
        raise BadArgument(
            f"{args.model} has no strands.npz: name a model folder made by 'hairstage reconstruct' "
            "or 'hairstage demo'"
        )
    capture = None if args.capture is None else Capture(args.capture)
    world = None if args.frame == "stage" else model.frame
    truth = None if args.truth is None else read_strands(args.truth, frame=world)
    name = args.model.resolve().name
    decoder = Decoder()
    viewing = Viewing(lambda: [name], lambda _: Viewed(model, capture, truth), decoder)
    viewed = viewing.get(name)
    viewed.about()  # read before the browser opens
    threading.Thread(target=viewed.prepare).start()
    key = secrets.token_urlsafe(24)

    def ready(url: str) -> None:
        address = f"{url}/view#model={quote(name, safe='')}&token={key}"
        output.result({"url": address, "model": str(args.model)}, f"{address}\n(Ctrl-C ends it)")

    exit_on_sigterm()
    access = Access(Tokens(args.model / "none", key))  # a key for this run
    try:
        serve_viewer(viewing, access, args.port, ready)
    finally:
        decoder.close()
