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
    """Write a model's page.

    Write MODEL/index.html: results, images, figures, warnings, plots and skipped work. Jobs,
    'reconstruct', 'fit', 'render' and 'edit' write it too.
    """
    from reconstruction import Model
    from stage_service.model_page import write_page

    model = Model(args.model)
    if not (model.has("strands.npz") or model.has("report.json")):
        raise BadArgument(
            f"{args.model} is not a model: it has neither strands.npz nor report.json"
        )
    page = write_page(model)
    output.result({"page": str(page)}, str(page))
