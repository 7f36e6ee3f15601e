"""A capture as its user has it: on a calibrated stage, without a digitised head."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from shooting import believed, shoot

from reconstruction import Capture, Projector, Rig, Step
from reconstruction.calibration.boards import Board
from reconstruction.calibration.rig_comparison import aligned, compare_rigs
from reconstruction.calibration.solve import TargetCaptures, Targets, calibrate
from reconstruction.capture.records import StepKind
from simulators.subject.props import SPHERES, PropResponder, SphereProp, board_pose

POSES = range(32)
SQUARE = 24
"""Pixels that a square of the board is wide, at least: its marker has six cells a side."""
SWEPT = 2
"""Boards that each projector sweeps: those that face it most."""
EXPOSURE = 0.02


def calibrated(rig: Rig) -> Rig:
    """`rig` as `hairstage calibrate rig` finds it from props before its cameras.

    From nominal places that are centimetres off; moved to where the true cameras are, as the world
    of strands is nobody's error.
    """
    nominal, board = believed(rig), _board(rig)
    swept = {p.name: _facing(p, board) for p in rig.projectors}
    with TemporaryDirectory() as folder:
        boards = [
            shoot(
                Path(folder) / f"board-{pose}",
                rig,
                PropResponder(rig, board_pose(pose, board), samples=2),
                _steps(_all_on(rig), *(_sweep(p) for p in rig.projectors if pose in swept[p.name])),
                written=nominal,
            )
            for pose in POSES
        ]
        spheres = [
            shoot(
                Path(folder) / f"sphere-{k}",
                rig,
                PropResponder(rig, SphereProp(place, 0.05, 0.8), samples=2),
                _steps(_all_on(rig), _single_lights(rig)),
                written=nominal,
            )
            for k, place in enumerate(SPHERES)
        ]
        found, _ = calibrate(nominal, TargetCaptures(boards, diffuse=spheres), Targets(board, 0.8))
    return aligned(found, rig)


def copied(capture: Capture, folder: Path, *, rig: Rig | None = None, head: bool = True) -> Capture:
    """The capture in `folder`, on another `rig` where one is given; its files are hard links."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(capture.path, folder, copy_function=os.link)
    if rig is not None:
        (folder / "rig.json").unlink()
        (folder / "rig.json").write_text(json.dumps(rig.to_dict()))
    if not head:
        (folder / "head.obj").unlink()
    return Capture(folder)


def rig_errors(found: Rig, truth: Rig) -> dict[str, float]:
    """The mean over devices of what `compare_rigs` tells of each."""
    comparison = compare_rigs(found, truth)
    return {
        f"{kind}: {what}": float(np.mean([np.mean(device[what]) for device in devices.values()]))
        for kind, devices in comparison.items()
        for what in next(iter(devices.values()))
    }


def _board(rig: Rig) -> Board:
    """The usual one, or one of fewer and larger squares where pixels are wide."""
    pixel = max(float(np.linalg.norm(c.center)) / c.K[0, 0] for c in rig.cameras)
    usual = Board()
    if SQUARE * pixel <= usual.square:
        return usual
    return Board(6, 4, SQUARE * pixel, SQUARE * pixel * usual.marker / usual.square)


def _facing(projector: Projector, board: Board) -> list[int]:
    """Numbers of the boards whose front faces it most."""
    away = projector.center / np.linalg.norm(projector.center)
    facing = [-board_pose(n, board).rotation[:, 2] @ away for n in POSES]
    return np.argsort(facing)[-SWEPT:].tolist()


def _steps(*parts: Iterator[Step] | Sequence[Step]) -> list[Step]:
    return [replace(step, index=k) for k, step in enumerate(chain(*parts))]


def _all_on(rig: Rig) -> list[Step]:
    """So many lamps as the rigs have, dimmed until white paper is half of a full channel."""
    return [_step("dark", level=0.0), _step("all_on", level=min(1.0, 6 / len(rig.lights)))]


def _single_lights(rig: Rig) -> Iterator[Step]:
    return (_step("olat", light=light.name) for light in rig.lights)


def _sweep(projector: Projector) -> Iterator[Step]:
    yield _step("tracking", exposure=0.1 * EXPOSURE)
    for row in range(projector.height):
        yield _step("scanline", projector=projector.name, row=row)


def _step(kind: StepKind, exposure: float = EXPOSURE, **more: Any) -> Step:
    return Step(0, kind, exposure, **more)
