# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Reflectance of one pixel
#
# Read a capture and plot a hair pixel's response to each of its lights over the dome.
# Usage: `python examples/reflectance.py [CAPTURE]`; without one a tiny capture is rendered.

# %%
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from tiny_capture import tiny_capture

from reconstruction import Capture

capture = Capture(sys.argv[1] if len(sys.argv) > 1 else tiny_capture())
camera = capture.rig.cameras[0]
lights = [capture.rig.light(name) for name in capture.olat_lights()]
print(f"{len(lights)} lights, {len(capture.rig.cameras)} cameras of {camera.width} pixels")

# %% [markdown]
# `olat` returns radiance `(lights, height, width, 3)` in W/(sr m²), and where it is known: not
# saturated and not missing. The pixel with the strongest highlight is the one whose maximum over
# lights exceeds its mean most.

# %%
response, known = capture.olat(camera.name)
grey = np.where(known, response.mean(axis=-1), 0.0)
highlight = grey.max(axis=0) - grey.mean(axis=0)
row, column = np.unravel_index(highlight.argmax(), highlight.shape)
pixel = grey[:, row, column]
brightest = lights[int(pixel.argmax())]
print(f"pixel ({column}, {row}): {pixel.max():.3g} W/(sr m²) under {brightest.name}")

# %% [markdown]
# Lights are drawn by direction: azimuth, and elevation in equal areas.

# %%
directions = np.array([light.position / np.linalg.norm(light.position) for light in lights])
azimuth = np.degrees(np.arctan2(directions[:, 0], -directions[:, 1]))
figure = Figure(figsize=(8, 3.5), layout="constrained")
axes = figure.subplots()
dots = axes.scatter(azimuth, directions[:, 2], c=pixel, s=30, cmap="inferno")
axes.set(xlabel="azimuth from the face (degrees)", ylabel="sine of elevation")
axes.set_title(f"{camera.name}, pixel ({column}, {row})")
figure.colorbar(dots, label="radiance, W/(sr m²)")
Path("runs").mkdir(exist_ok=True)
figure.savefig("runs/reflectance.png", dpi=100)
print("runs/reflectance.png")
