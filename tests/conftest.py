"""What every test may ask for."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]


@pytest.fixture
def shared_data() -> Callable[[str], Path]:
    """`shared_data(name)`: a file or folder of the test data, or a skip that says what to set.

    The data is looked for in $HAIRSTAGE_DATA, then in ../shared/data beside the checkout.
    """

    def locate(name: str) -> Path:
        folder = Path(os.environ.get("HAIRSTAGE_DATA", CHECKOUT.parent / "shared" / "data"))
        path = folder / name
        if not path.exists():
            pytest.skip(f"no test data at {path}; point HAIRSTAGE_DATA at the folder that has it")
        return path

    return locate
