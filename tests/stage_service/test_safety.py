"""Blackout, where a device answers with something that nobody foresaw."""

from types import SimpleNamespace

from stage_service.safety import blackout


class Broken:
    """A light bank whose driver has a fault of its own."""

    name = "lights"
    capabilities = SimpleNamespace(reads_back=True)

    def off(self):
        raise ZeroDivisionError("a fault of the driver")


class Beams:
    name = "projectors"
    capabilities = SimpleNamespace(reads_back=True)
    lit = True

    def off(self):
        self.lit = False

    def is_dark(self):
        return not self.lit


def test_a_fault_of_one_driver_does_not_keep_the_projectors_lit():
    beams = Beams()
    stage = SimpleNamespace(
        lights=Broken(), projectors=beams, config=SimpleNamespace(watchdog_s=2.0)
    )
    result = blackout(stage, attempts=1)
    assert not beams.lit
    assert not result.safe
    assert "ZeroDivisionError: a fault of the driver" in result.detail
