"""`head`: fit a head mesh to digitised points; make a template of a user's mesh."""

from __future__ import annotations

import argparse
from pathlib import Path

from stage_service.cli.support.commands import (
    BadArgument,
    Commands,
    Output,
    add_command,
    add_group,
)


def add(commands: Commands) -> None:
    """Add the commands."""
    group = add_group(commands, "head", "head meshes for captures without one")
    fit = add_command(group, "fit", run_fit)
    fit.add_argument("points", type=Path)
    fit.add_argument(
        "--part",
        choices=["head", "scalp"],
        default="scalp",
        help="the surface that the points lie on",
    )
    fit.add_argument("--mesh", type=Path, help="the head mesh to fit (default: the generic one)")
    fit.add_argument(
        "--turn-deg", type=float, help="turn of the head about z, if known; 0 faces −y"
    )
    fit.add_argument("--out", type=Path, required=True, help=".obj")

    mark = add_command(group, "mark", run_mark)
    mark.add_argument("mesh", type=Path, help=".obj")
    mark.add_argument("--up", choices=["y", "z"], default="z", help="the mesh's upward axis")
    mark.add_argument(
        "--above", type=float, help="cut off all below this height, in the mesh's unit"
    )
    mark.add_argument("--out", type=Path, required=True, help=".obj")


def run_fit(args: argparse.Namespace, output: Output) -> None:
    """Fit a head mesh to points of a head or of its scalp.

    Fit the generic head, or --mesh, to points (.obj, .ply, .csv, .npy; metres, z up) and write it
    with its scalp marked, for a capture's head.obj.
    """
    import numpy as np

    from reconstruction import read_obj, write_obj
    from reconstruction.files.durable import writing
    from reconstruction.files.points import read_points
    from reconstruction.head.fit import HeadHints, fit_head
    from reconstruction.head.generic import generic_head
    from reconstruction.head.template import template

    _require_obj(args.out)
    if args.turn_deg is not None and not np.isfinite(args.turn_deg):
        raise BadArgument(f"--turn-deg {args.turn_deg}: expected a number of degrees")
    shape, marked = generic_head(), None
    if args.mesh is not None:
        shape, marked = template(read_obj(args.mesh))
    points, normals = read_points(args.points)
    turn = None if args.turn_deg is None else float(np.radians(args.turn_deg))
    fit = fit_head(points, normals, shape, hints=HeadHints(part=args.part, turn=turn))
    with writing(args.out) as part:
        write_obj(part, fit.mesh)
    rms, used = 1e3 * fit.deformed.to_mesh_rms, 1 - float(fit.outliers.mean())
    warnings = [f"{args.mesh}: its scalp: {w}" for w in (marked.warnings if marked else ())]
    warnings += fit.warnings
    lines = [f"{args.out}: {rms:.2f} mm rms from {used:.0%} of {len(points)} points"]
    lines += [f"warning: {w}" for w in warnings]
    output.result(
        {
            "head": str(args.out),
            "points": len(points),
            "rms_mm": rms,
            "used_share": used,
            "fit": fit.figures(),
            "warnings": warnings,
        },
        "\n".join(lines),
    )


def run_mark(args: argparse.Namespace, output: Output) -> None:
    """Make a template of a head mesh: upright, in metres, with its scalp marked.

    Cut and turn a head or body in any unit, mark the generic head's scalp on it, and write it in
    the generic head's frame, for 'head fit --mesh' or the option head_mesh.
    """
    from reconstruction import read_obj, write_obj
    from reconstruction.files.durable import writing
    from reconstruction.head.template import template

    _require_obj(args.out)
    mesh, fit = template(read_obj(args.mesh), up=args.up, above=args.above)
    with writing(args.out) as part:
        write_obj(part, mesh)
    assert mesh.scalp is not None
    scalp = float(mesh.face_areas()[mesh.scalp].sum() * 1e4)
    data = {"head": str(args.out), "faces": len(mesh.faces), "scalp_cm2": scalp}
    lines = [f"{args.out}: {scalp:.0f} cm² of scalp on {len(mesh.faces)} faces"]
    if fit is not None:
        data |= {"unit_m": 1 / fit.pose.scale, "fit": fit.figures(), "warnings": list(fit.warnings)}
        lines += [f"warning: {w}" for w in fit.warnings]
    output.result(data, "\n".join(lines))


def _require_obj(path: Path) -> None:
    if path.suffix != ".obj":
        raise BadArgument(f"--out must end in .obj, got {path}")
    path.parent.mkdir(parents=True, exist_ok=True)
