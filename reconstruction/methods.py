"""The names of the reconstruction's methods, for whoever only passes them on."""

from typing import Literal, get_args

Method = Literal["auto", "light_planes", "photometric", "lmvs", "fused", "hull"]
"""Planes of light (Photobooth), lightcodes (Sun 2021), the baseline without (Nam 2019), or both;
the hull's smooth field, pulled by what is measured; what the capture holds decides."""

METHODS: tuple[str, ...] = get_args(Method)
