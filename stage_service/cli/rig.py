"""`rig check`: devices of a rig file and their triangulation angles."""

from __future__ import annotations

import argparse
from typing import Any

from stage_service.cli.support.commands import Commands, Output, add_command, add_group, rig_path


def add(commands: Commands) -> None:
    """Add the command."""
    group = add_group(commands, "rig", "inspect rig files")
    check = add_command(group, "check", run_check)
    check.add_argument("file", type=rig_path, help="rig file (.toml or .json)")
    check.add_argument("--radius", type=float, default=0.12, help="of the sphere, metres")


def run_check(args: argparse.Namespace, output: Output) -> None:
    """Check a rig file and report the angles between camera rays and planes of light.

    Report the rig's devices, the cost of its full capture, and for each camera and projector the
    angle between camera rays and planes of light on a head-sized sphere. Near 0° depth is
    undetermined.
    """
    from reconstruction.light_planes.plane_conditioning import condition
    from stage_service.config import load_rig_file
    from stage_service.devices.device_set import DeviceSet
    from stage_service.plan.capture_plan import CapturePlan
    from stage_service.plan.resolved import resolve

    rig_file = load_rig_file(args.file)
    rig = rig_file.rig
    if rig_file.devices is not None:
        DeviceSet.of(rig_file)  # raises as a service would, without a connection
    data: dict[str, Any] = {
        "rig": rig.name,
        "cameras": len(rig.cameras),
        "lights": len(rig.lights),
        "projectors": len(rig.projectors),
        "lights_beside_cameras": sum(light.beside is not None for light in rig.lights),
        "cost": resolve(CapturePlan(), rig_file).cost.model_dump(mode="json"),
        "warnings": [],
        "triangulation": None,
    }
    if rig.projectors:
        found = condition(rig, radius=args.radius)
        data["triangulation"] = found.to_dict()
        if found.triangulated < 0.5:
            data["warnings"].append(
                f"only {found.triangulated:.0%} of the visible sphere is triangulated at "
                f"{found.well_deg:g}° or more: turn or move projectors"
            )
    else:
        data["warnings"].append("no projectors: nothing to triangulate")
    alone = {c.name for c in rig.cameras} - {light.beside for light in rig.lights}
    if alone:
        data["warnings"].append(
            f"no light beside {sorted(alone)}: visibility is less certain there"
        )
    output.result(data, _table(data))


def _table(data: dict[str, Any]) -> Any:
    from rich.console import Group
    from rich.table import Table

    cost = data["cost"]
    head = (
        f"{data['rig']}: {data['cameras']} cameras, {data['lights']} lights "
        f"({data['lights_beside_cameras']} beside cameras), {data['projectors']} projectors; a "
        f"full capture is {cost['frames']} frames, {cost['bytes'] / 1e9:.1f} GB, "
        f"{cost['seconds']:.0f} s"
    )
    parts: list[Any] = [head]
    found = data["triangulation"]
    if found is not None:
        table = Table("camera", "projector", "shared", "median angle", "5 % below", "mm per row")
        for pair in found["pairs"]:
            angles = [pair["median_angle_deg"], pair["low_angle_deg"]]
            row = pair["metres_per_row"]
            table.add_row(
                pair["camera"],
                pair["projector"],
                f"{pair['shared']:.0%}",
                *("–" if a is None else f"{a:.0f}°" for a in angles),
                "–" if row is None else f"{1000 * row:.1f}",
            )
        parts += [
            table,
            f"{found['visible']:.0%} of the sphere is visible, {found['triangulated']:.0%} of that "
            f"triangulated at {found['well_deg']:g}° or more",
        ]
    return Group(*parts, *(f"warning: {w}" for w in data["warnings"]))
