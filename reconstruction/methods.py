"""The names of the reconstruction's methods, for whoever only passes them on."""

from typing import Literal, get_args

Method = Literal["light_planes", "photometric", "lmvs", "fused"]
"""Planes of light (Photobooth), lightcodes (Sun 2021), the baseline without (Nam 2019), or both."""

METHODS: tuple[str, ...] = get_args(Method)
