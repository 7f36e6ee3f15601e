"""Files and names in requests: read and checked, with the field in each error."""

from __future__ import annotations

from pathlib import Path

from appearance.render.environment_maps import PROCEDURAL
from reconstruction import Mesh, Rig
from reconstruction.arrays import Bools
from reconstruction.containment import plain_file
from stage_service.captures.snapshots import SNAPSHOT
from stage_service.decoding import Decoder
from stage_service.jobs.pipelines import PIPELINES
from stage_service.jobs.records import PipelineRequest


class BadInput(ValueError):
    """A file or name in a request cannot be used."""


def read_head(path: Path, decoder: Decoder) -> Mesh:
    """The head of an OBJ file. Raises `BadInput`, `DecoderBusy`."""
    try:
        return decoder.head(plain_file(path), str(path))
    except (OSError, ValueError) as error:
        raise BadInput(f"head: {error}") from error


def read_masks(folder: Path, rig: Rig, decoder: Decoder) -> dict[str, Bools]:
    """The masks `<camera>.png` of the rig's cameras, `(height, width)` each. Raises `BadInput`,
    `DecoderBusy`."""
    masks = {}
    for camera in rig.cameras:
        path = folder / f"{camera.name}.png"
        try:
            size = camera.width, camera.height
            masks[camera.name] = decoder.mask(plain_file(path), str(path), *size)
        except FileNotFoundError:
            continue
        except (OSError, ValueError) as error:
            raise BadInput(f"masks: {error}") from error
    if not masks:
        raise BadInput(f"masks: {folder} has no <camera>.png of this rig's cameras")
    return masks


def check_kept(capture: str) -> None:
    """Raises `BadInput` for the snapshot, which the next one replaces."""
    if capture == SNAPSHOT:
        raise BadInput("capture: a snapshot is kept until the next one only: shoot a capture")


def check_new(pipeline: PipelineRequest, rig: Rig, head: bool) -> None:
    """Raises `BadInput` where the pipeline cannot follow a new capture, with a head or without."""
    check_named(pipeline, rig)
    if "reconstruct" not in PIPELINES[pipeline.name]:
        raise BadInput(
            f"pipeline: {pipeline.name!r} needs existing strands; a new capture has none"
        )
    method = pipeline.options.method
    if not head and method in ("light_planes", "fused"):
        raise BadInput(
            f"pipeline: {method!r} roots strands on a scalp: give the head, or the method 'auto'"
        )


def check_named(pipeline: PipelineRequest, rig: Rig) -> None:
    """Raises `BadInput` where options name what the rig lacks, or a missing file."""
    options = pipeline.options
    for kind, wanted, known in (
        ("held_out_cameras", options.held_out_cameras, rig.cameras),
        ("held_out_lights", options.held_out_lights, rig.lights),
    ):
        unknown = set(wanted) - {x.name for x in known}
        if unknown:
            raise BadInput(f"pipeline.options.{kind}: the rig has no {sorted(unknown)}")
    strands = options.reconstruct
    for field, file in (
        ("truth", options.truth),
        ("environment", None if options.environment in PROCEDURAL else options.environment),
        ("reconstruct.head_mesh", strands.head_mesh),
        ("reconstruct.scalp_points", strands.scalp_points),
    ):
        try:
            if file is not None and not (field == "truth" and Path(file).is_dir()):
                plain_file(file)
        except (OSError, ValueError) as error:
            raise BadInput(f"pipeline.options.{field}: {error}") from error
