"""The extended hair BSDF: lobes, their readable reference, absorption, and the Mitsuba plugin."""

from __future__ import annotations

import mitsuba as mi


def register() -> None:
    """Make `extended_hair` known to Mitsuba, in the current variant and in those set later.

    Only Mitsuba itself is imported before a variant with RGB arrays is set.
    """

    def on_variant(old: str | None, new: str | None) -> None:
        if new in ("llvm_ad_rgb", "cuda_ad_rgb"):
            from appearance.bsdf.plugin import plugin

            mi.register_bsdf("extended_hair", plugin())

    mi.detail.add_variant_callback(on_variant)
    on_variant(None, mi.variant())
