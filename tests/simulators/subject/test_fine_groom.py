"""Fine grooms from coarse ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from reconstruction import Strands, write_strands
from simulators.subject.fine_groom import FIBRES, RADIUS, FineGroom, fine_groom
from simulators.subject.grooms import covering_radius
from simulators.subject.subject import load_subject

CENTER = (0.0, 0.0, 0.05)


def guides(side: int = 20) -> Strands:
    """Straight guides 10 cm long, 2 mm apart, with points every 2 cm."""
    x, y = np.meshgrid(*[2e-3 * np.arange(side) - 1e-3 * side] * 2)
    z = np.linspace(0, 0.1, 6)
    lines = [
        np.stack([a + 0 * z, b + 0 * z, z], axis=1) for a, b in zip(x.flat, y.flat, strict=True)
    ]
    return Strands.from_list(lines, 4e-5)


def test_the_ball_holds_all_fibres_and_the_rest_the_guides() -> None:
    made = fine_groom(guides(), CENTER, 0.015)
    inside = np.linalg.norm(made.points - CENTER, axis=1) < 0.015
    radius = np.asarray(made.radius)
    np.testing.assert_allclose(radius[inside], RADIUS)
    np.testing.assert_allclose(radius[~inside], covering_radius(400), rtol=1e-6)
    each = FIBRES / 400
    across = np.linalg.norm(made.points[:, :2], axis=1) < 8e-3
    level = across[1:] & (made.points[1:, 2] >= 0.0502) & (made.points[:-1, 2] < 0.0502)
    wanted = each * np.pi * 8e-3**2 / 2e-3**2  # a guide to 4 mm²
    assert level.sum() == pytest.approx(wanted, rel=0.1)


def test_children_lie_within_the_spread_of_their_guide() -> None:
    plain = FineGroom(spread=0.5, clumping=0.0, deviation=0.0, fly_aways=0.0)
    made = fine_groom(guides(), CENTER, 0.015, plain)
    fine = made.points[np.asarray(made.radius) < 5e-5]
    away = cKDTree(guides().points[::6, :2]).query(fine[:, :2])[0]
    assert away.max() <= 1e-3 + 1e-6
    assert np.median(away) == pytest.approx(1e-3 / np.sqrt(2), rel=0.05)  # of a filled disk


@pytest.mark.slow
def test_coarse_guides_become_smooth_curves() -> None:
    """A circle of 4 mm radius by eight points: children turn by degrees, not by 45."""
    a = np.linspace(0, 2 * np.pi, 9)
    ring = np.stack([4e-3 * np.cos(a), 4e-3 * np.sin(a), 0.05 + 0 * a], axis=1)
    two = Strands.from_list([ring, ring + np.array([0.0, 0.0, 2e-3])], 4e-5)
    plain = FineGroom(spread=0.0, deviation=0.0)
    made = fine_groom(two, CENTER, 0.02, plain)
    t = made.resampled(1e-3).tangents()[:20]
    turn = np.degrees(np.arccos(np.clip((t[1:] * t[:-1]).sum(axis=1), -1, 1)))
    assert turn.max() < 25  # a millimetre of the circle is 14 degrees


def test_a_ball_beside_the_hair_is_refused() -> None:
    with pytest.raises(ValueError, match="no strand passes the ball"):
        fine_groom(guides(3), (1.0, 0.0, 0.0), 0.01)


def test_a_fine_groom_keeps_its_radii_as_a_subject(tmp_path) -> None:
    file = tmp_path / "fine.npz"
    write_strands(file, fine_groom(guides(), CENTER, 0.015))
    lines: list[str] = []
    subject = load_subject(str(file), say=lines.append)
    assert np.asarray(subject.strands.radius).min() == pytest.approx(RADIUS)
