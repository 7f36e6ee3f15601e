"""Results held against what heads and hair are.

A head has about 4.5 litres, hair 5 cm thick all around 8 more; hair of 2 m is the exception. A
scalp of 600 to 700 cm² has 100,000 to 150,000 hairs (C. R. Robbins: Chemical and Physical Behavior
of Human Hair, 2012, ch. 1 and 9). Tufts, braids and patches of hair are subjects too: what is too
small causes a warning only.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from reconstruction.arrays import Bools
from reconstruction.capture.records import CaptureError
from reconstruction.geometry.collisions import Collisions
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.rig import Rig
from reconstruction.geometry.strands import Strands
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.masks import MaskedCapture
from reconstruction.report.report import Stage

HEAD_LITRES = 2.0, 15.0
"""A head with its hair."""
MOST_LITRES = 60.0
"""No hair is larger: that of a person, or 2 m of a wall."""
LENGTHS = 0.05, 2.0
"""Metres of the longest strands."""
HAIRS, MOST_HAIRS = 125_000, 150_000
SCALP = 0.065
"""Square metres."""
DENSEST = 300.0
"""Hairs per cm² of scalp."""
OTHER_BODY = 0.25
"""Share of the largest part's volume from which another part is a body of its own."""
MEETING = 0.6
"""Share of a mask that the common volume covers from which it fits the other cameras'."""
COVERED_FACE = 0.05
WAYS = (
    "provide masks of the subject (subjects/CAMERA.png), clean plates or head.obj, and check the "
    "scale (hairstage import --unit)"
)


def check_volume(masked: MaskedCapture, hull: VoxelGrid, what: str, stage: Stage) -> None:
    """Hold the volume of `hull`, named `what`, against a head's; warn or raise `CaptureError`.

    A lit background is part of every silhouette, which then reaches all edges of the image.
    """
    litres, (least, most) = 1e3 * hull.volume, HEAD_LITRES
    said = f"{what} has {litres:.3g} litres, a head with hair {least:g} to {most:g}"
    if litres > most:
        full = [name for name, mask in masked.masks.items() if _at_all_edges(mask.subject)]
        if 2 * len(full) >= len(masked.masks):
            raise CaptureError(
                f"{said}, and the silhouettes of {', '.join(full[:8])} reach all edges of their "
                f"images, as a lit background makes them: {WAYS}"
            )
        if litres > MOST_LITRES:
            raise CaptureError(f"{said}: {WAYS}")
        stage.warn(f"{said}: if something else is visible, {WAYS}")
    elif litres < least:
        stage.warn(f"{said}: if it is no patch or tuft of hair, {WAYS}")


def check_places(rig: Rig, hull: VoxelGrid) -> None:
    """Raise `CaptureError` for a camera or light of `rig` inside the subject's `hull`."""
    places = {c.name: c.center for c in rig.cameras} | {x.name: x.position for x in rig.lights}
    if inside := [name for name, place in places.items() if hull.contains(place)]:
        raise CaptureError(
            f"{', '.join(inside[:8])}: inside the subject, where no camera and no light can be: "
            "check positions, unit (--unit, --light-unit) and axes"
        )


def check_subject(masked: MaskedCapture, hull: VoxelGrid, stage: Stage) -> None:
    """Hold the whole subject's `hull` against the masks; warn or raise `CaptureError`."""
    parts, count = ndimage.label(hull.inside)
    sizes = np.sort(np.bincount(parts.ravel(), minlength=count + 1)[1:])[::-1]
    litres = 1e3 * hull.spacing**3 * sizes
    others = litres[1:][litres[1:] > OTHER_BODY * litres[:1]]
    if len(others):
        stage.warn(
            f"the subject has {1 + len(others)} separate parts of "
            f"{', '.join(f'{x:.2g}' for x in litres[: 1 + len(others)])} litres: if one is another "
            "person, a mirror image or a stand, provide masks of the subject (subjects/CAMERA.png)"
        )
    covered = {c.name: _covered(masked, hull, c.name) for c in masked.cameras}
    stage.figures["mask_covered"] = covered
    if off := {name: share for name, share in covered.items() if share < MEETING}:
        shares = ", ".join(f"{name} {share:.0%}" for name, share in off.items())
        text = (
            f"masks of the subject do not meet in space; share of a mask that the other cameras "
            f"confirm: {shares}; check the poses and that the images are those of their cameras "
            "(exchanged cameras, mirrored axes or images, a mirror or someone else in view)"
        )
        if 2 * len(off) > len(covered):
            raise CaptureError(text)
        stage.warn(text)


def usual_hairs(area: float | None) -> int:
    """The hairs that a scalp of `area` m² has; None: those of a head."""
    return int(HAIRS if area is None else HAIRS * min(area / SCALP, 1.0))


def check_strands(strands: Strands, area: float | None, stage: Stage) -> None:
    """Hold `strands` against hair; `area` is the scalp's, m², None if unknown."""
    longest = float(np.quantile(strands.lengths(), 0.95))
    if not LENGTHS[0] <= longest <= LENGTHS[1]:
        stage.warn(
            f"the longest strands have {100 * longest:.2g} cm, a head's hair {100 * LENGTHS[0]:g} "
            f"to {100 * LENGTHS[1]:g} cm: if the hair is not so, check the scale (hairstage import "
            "--unit)"
        )
    most = MOST_HAIRS if area is None else min(MOST_HAIRS, DENSEST * 1e4 * area)
    if len(strands) > most:
        where = "a head" if area is None else f"{1e4 * area:.0f} cm² of scalp"
        metres, bound = strands.lengths().sum(), most * strands.lengths().mean()
        stage.warn(
            f"{len(strands)} strands ({metres:.0f} m) are more than the {most:.0f} hairs "
            f"({bound:.0f} m) of {where}: some are not hair; {WAYS}"
        )


def check_face(strands: Strands, head: Mesh, stage: Stage) -> None:
    """Warn of hair in front of the face of a `head` with a marked scalp."""
    if head.scalp is None or not head.scalp.any() or not len(strands):
        return
    top = float(head.vertices[:, 2].max())
    scalp = head.vertices[np.unique(head.faces[head.scalp])]
    upper = head.vertices[head.vertices[:, 2] > top - 0.22]
    forward = np.append((upper.mean(axis=0) - scalp.mean(axis=0))[:2], 0.0)
    if not np.linalg.norm(forward) > 5e-3:  # metres: the scalp has no front
        return
    forward /= np.linalg.norm(forward)
    low, high = top - 0.22, top - 0.12  # from the chin to the eyes
    face = upper[upper[:, 2] < high]
    middle, front = face.mean(axis=0), float((face @ forward).max())
    points = strands.points.astype(float)
    aside = np.abs((points - middle) @ np.cross(forward, [0, 0, 1.0]))
    before = (points @ forward > front - 0.03) & (aside < 0.05)
    before &= (points[:, 2] > low) & (points[:, 2] < high)
    stage.figures["before_face"] = share = float(before.mean())
    if share > COVERED_FACE:
        stage.warn(
            f"{share:.0%} of the hair is in front of the face, between eyes and chin: if the face "
            "is bare, provide hair masks, and check the head's place (head.obj)"
        )


def check_inside(strands: Strands, head: Mesh, stage: Stage) -> None:
    """Record how much of the hair is inside the `head`; warn of a mesh without an inside."""
    try:
        stage.figures["inside_head"] = Collisions(strands, head).inside.figures()
    except ValueError as error:
        stage.warn(f"strands inside the head are not counted: {error}")


def _at_all_edges(mask: Bools) -> bool:
    return bool(mask[0].any() and mask[-1].any() and mask[:, 0].any() and mask[:, -1].any())


def _covered(masked: MaskedCapture, hull: VoxelGrid, name: str) -> float:
    """The share of a camera's subject mask that `hull` covers."""
    camera, mask = masked.capture.rig.camera(name), masked.masks[name].subject
    visible, x, y, depth = camera.pixels_of(hull.centers())
    seen = np.zeros(mask.shape, bool)
    seen[y[visible], x[visible]] = True
    if visible.any():
        wide = hull.spacing * camera.K[0, 0] / float(np.median(depth[visible]))
        seen = ndimage.binary_dilation(seen, iterations=int(np.ceil(wide)))
    return float((seen & mask).sum() / max(int(mask.sum()), 1))
