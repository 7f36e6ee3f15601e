"""A tuft of strands with their places on the scalp's map."""

from __future__ import annotations

import pytest

from appearance.bsdf.maps import scalp_coordinates


@pytest.fixture(scope="session")
def strands(small):
    return small.tuft(300)


@pytest.fixture(scope="session")
def root_uv(strands):
    return scalp_coordinates(strands, None)
