"""`hairstage edit`: change colour, roughness, length or strands of a fitted model."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stage_service.cli.support.commands import BadArgument, Commands, Output, add_command

if TYPE_CHECKING:
    from appearance import FittedModel
    from appearance.bsdf.maps import HairMaps
    from reconstruction.arrays import Array

WISP_CELLS = 32
"""Least number of cells across the scalp's map for --wisp."""
OFF = 0.02
"""Median distance of roots, metres, beyond which other strands are on another scalp."""
DYED_LAYERS = 8
"""Least number of layers along strands for --along."""


def add(commands: Commands) -> None:
    """Add the command."""
    edit = add_command(commands, "edit", run)
    edit.add_argument("model", type=Path, help="fitted model folder")
    edit.add_argument("--out", type=Path, required=True, help="the new model folder")
    edit.add_argument("--capture", type=Path, help="the capture, for its head")
    edit.add_argument("--strands", type=Path, help="a strand file that gets the model's appearance")
    edit.add_argument(
        "--cut", type=float, metavar="METRES", help="cut longer strands to this length"
    )
    colour = edit.add_mutually_exclusive_group()
    colour.add_argument(
        "--recolour",
        type=_numbers(3),
        metavar="R,G,B",
        help="colour of dense hair, linear RGB, above 0 and at most 1",
    )
    colour.add_argument(
        "--pigment",
        type=_numbers(2),
        metavar="EU,PHEO",
        help="concentrations of eumelanin (black-brown) and pheomelanin (red), 0 or more: about "
        "1.3,0.2 is brown",
    )
    edit.add_argument(
        "--wisp",
        type=_numbers(3),
        metavar="U,V,RADIUS",
        help="colour only strands rooted within RADIUS of (U, V) on the scalp's map (0 to 1)",
    )
    edit.add_argument(
        "--along",
        type=_numbers(2),
        default="0,1",
        metavar="FROM,TO",
        help="colour only this part of the strands, 0 <= FROM < TO <= 1, 0 the root and 1 the tip",
    )
    edit.add_argument("--roughen", type=float, metavar="FACTOR", help="times the roughness beta_m")


def run(args: argparse.Namespace, output: Output) -> None:
    """Change colour, roughness, length or strands of a fitted model.

    Write the edited MODEL as a new model folder, for render and export. Edits are applied in this
    order: strands, cut, colour, roughness.
    """
    import numpy as np
    from scipy.spatial import cKDTree

    from appearance import FittedModel
    from appearance.model.edit import cut, restyled, roughened
    from reconstruction import Capture, Model, read_strands
    from stage_service.model_page import write_page

    names = ("strands", "cut", "recolour", "pigment", "roughen")
    edits = {n: getattr(args, n) for n in names if getattr(args, n) is not None}
    if not edits:
        raise BadArgument(f"no edit is given: use one of {', '.join('--' + n for n in names)}")
    if (args.wisp or args.along != (0.0, 1.0)) and not {"recolour", "pigment"} & set(edits):
        raise BadArgument("--wisp and --along need --recolour or --pigment")
    if args.out.exists() and not (args.out.is_dir() and not any(args.out.iterdir())):
        raise BadArgument(f"--out {args.out} is not an empty folder: choose a new one")
    source = Model(args.model)
    fitted = FittedModel.load(source, Capture(args.capture) if args.capture else None)
    if args.strands is not None:
        before, fitted = fitted, restyled(fitted, read_strands(args.strands, frame=source.frame))
        distance, _ = cKDTree(before.strands.roots).query(fitted.strands.roots)
        off = float(np.median(distance))
        if off > OFF:
            output.note(
                f"warning: roots of {args.strands} are {off:.2g} m (median) from the model's: "
                "check "
                "that the file is in metres, z up, in the model's frame"
            )
    if args.cut is not None:
        fitted = cut(fitted, args.cut)
    if args.recolour or args.pigment:
        fitted = fitted.with_maps(_coloured(fitted, args))
    if args.roughen is not None:
        fitted = fitted.with_maps(roughened(fitted.maps, args.roughen))
    model = Model(args.out)
    model.create().start(source.frame)
    fitted.save(model)
    if source.has("scalp_map.npz"):
        roots = fitted.root_uv.astype(np.float32)
        model.write_arrays("scalp_map.npz", {**source.arrays("scalp_map.npz"), "roots": roots})
    write_page(model)
    if fitted.head is None:
        output.note(
            f"warning: {args.model} has no head, so {model} is rendered without one: give "
            "--capture if the capture has a head"
        )
    data: dict[str, Any] = {"model": str(model), "strands": len(fitted.strands)}
    data["edits"] = {k: str(v) if isinstance(v, Path) else v for k, v in edits.items()}
    output.result(data, f"{model}: {', '.join(edits)}; see it with 'hairstage render {model}'")


def _coloured(fitted: FittedModel, args: argparse.Namespace) -> HairMaps:
    import numpy as np

    from appearance.model.edit import recoloured, refined, wisp_of

    layers = DYED_LAYERS if args.along != (0.0, 1.0) else 1
    cells = 1 if args.wisp is None else WISP_CELLS
    maps, brush = refined(fitted.maps, (layers, cells, cells)), np.ones((1, 1))
    if args.wisp is not None:
        u, v, radius = args.wisp
        uv = fitted.root_uv
        inside = np.flatnonzero(np.hypot(uv[:, 0] - u, uv[:, 1] - v) <= radius)
        if not len(inside):
            raise BadArgument(f"--wisp: no strand is rooted within {radius} of ({u}, {v})")
        brush = wisp_of(inside, uv, maps.shape[1:])
    return recoloured(maps, brush, _absorption(args, maps.beta_n), along=args.along)


def _absorption(args: argparse.Namespace, beta_n: float) -> Array:
    import numpy as np

    from appearance.bsdf.absorption import of_melanin
    from appearance.bsdf.longitudinal import absorption_of_colour

    if args.pigment is not None:
        if min(args.pigment) < 0:
            raise BadArgument(f"--pigment: concentrations must be 0 or more, got {args.pigment}")
        return np.array(of_melanin(*args.pigment))
    if not all(0 < c <= 1 for c in args.recolour):
        raise BadArgument(f"--recolour: three numbers above 0 and at most 1, got {args.recolour}")
    return absorption_of_colour(args.recolour, beta_n)


def _numbers(count: int) -> Callable[[str], tuple[float, ...]]:
    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(x) for x in text.split(","))
        except ValueError:
            values = ()
        if len(values) != count:
            raise argparse.ArgumentTypeError(f"expected {count} numbers with commas, got {text!r}")
        return values

    return parse
