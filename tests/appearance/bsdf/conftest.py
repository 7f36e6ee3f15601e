"""Every test of the BSDF runs on a set back end."""

import pytest

from appearance.scene.backend import ensure_backend


@pytest.fixture(scope="session", autouse=True)
def backend():
    return ensure_backend()
