"""`head`: a head under digitised points, and a user's mesh made a template."""

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
    group = add_group(commands, "head", "heads for captures that have none")
    fit = add_command(group, "fit", run_fit)
    fit.add_argument("points", type=Path)
    fit.add_argument("--part", choices=["head", "scalp"], default="scalp", help="what they lie on")
    fit.add_argument("--mesh", type=Path, help="the head to lay there (default: the generic one)")
    fit.add_argument("--turn-deg", type=float, help="of the head about z, where known; 0 faces −y")
    fit.add_argument("--out", type=Path, required=True, help=".obj")

    mark = add_command(group, "mark", run_mark)
    mark.add_argument("mesh", type=Path, help=".obj")
    mark.add_argument("--up", choices=["y", "z"], default="z", help="the mesh's upward axis")
    mark.add_argument("--above", type=float, help="cut off what is lower, in the mesh's unit")
    mark.add_argument("--out", type=Path, required=True, help=".obj")


def run_fit(args: argparse.Namespace, output: Output) -> None:
    """Lay a head mesh under points of a head or of its scalp.

    Fit the generic head, or the user's, to points (.obj, .ply, .csv, .npy; metres, z up) and write
    it with its scalp marked: put it into a capture as head.obj.
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
    """A user's head mesh as a template: upright, in metres, its scalp marked.

    Cut and turn a head or body of any unit, mark the generic head's scalp on it, and write it in
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
