"""`hairstage page`: a model's `index.html`."""

from __future__ import annotations

import argparse
from pathlib import Path

from stage_service.cli.support.commands import BadArgument, Commands, Output, add_command


def add(commands: Commands) -> None:
    """Add the command."""
    page = add_command(commands, "page", run)
    page.add_argument("model", type=Path)


def run(args: argparse.Namespace, output: Output) -> None:
    """One page on a model.

    Write MODEL/index.html: which of its files is the result, pictures, figures, warnings, plots,
    what was left out. Jobs, 'reconstruct', 'fit', 'render' and 'edit' write it by themselves.
    """
    from reconstruction import Model
    from stage_service.model_page import write_page

    model = Model(args.model)
    if not (model.has("strands.npz") or model.has("report.json")):
        raise BadArgument(f"{args.model} is no model: neither strands.npz nor report.json is there")
    page = write_page(model)
    output.result({"page": str(page)}, str(page))
