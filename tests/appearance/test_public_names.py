"""What `appearance` offers by name is there, and costs nothing before it is asked for."""

import subprocess
import sys

import appearance


def test_every_name_is_what_it_says():
    assert "FittedModel" in appearance.__all__
    for name in appearance.__all__:
        assert getattr(appearance, name).__name__ == name


def test_fits_are_imported_on_first_use():
    code = "import sys, appearance; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "appearance.bsdf" in done.stdout.split()
    assert "appearance.sun_fit.fit" not in done.stdout.split()
