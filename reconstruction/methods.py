"""The names of the reconstruction's methods."""

from typing import Literal, get_args

Method = Literal["auto", "light_planes", "photometric", "lmvs", "fused", "hull"]
"""`light_planes` (Photobooth), `photometric` (lightcodes, Sun 2021), `lmvs` (Nam 2019), `fused`
(light planes and lightcodes), `hull` (smooth field of the visual hull); `auto` chooses by the
capture."""

METHODS: tuple[str, ...] = get_args(Method)
