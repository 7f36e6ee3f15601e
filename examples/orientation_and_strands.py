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
# # Orientation and strands
#
# Estimate the 2D orientation of hair in one camera, then reconstruct strands from the capture.
# Usage: `python examples/orientation_and_strands.py [CAPTURE]`

# %%
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from tiny_capture import tiny_capture

from reconstruction import Capture, Model, ReconstructOptions, reconstruct
from reconstruction.images.orientation import orientations

tiny = len(sys.argv) < 2
capture = Capture(tiny_capture() if tiny else sys.argv[1])
camera = capture.rig.cameras[0]

# %% [markdown]
# One image per light; their filter responses add up. Angles are in [0, π), undirected, from +x
# towards +y (down).

# %%
images = capture.olat(camera.name)[0].mean(axis=-1)
mask = capture.mask(camera.name)
if mask is None:
    mask = images.sum(axis=0) > 0.1 * images.sum(axis=0).max()
found = orientations(images[::8], mask)
sure = found.confidence > np.median(found.confidence[mask])
print(f"{sure.sum()} of {mask.sum()} hair pixels with a confidence above the median")

# %%
figure = Figure(figsize=(7, 3.5), layout="constrained")
left, right = figure.subplots(1, 2)
left.imshow(images.sum(axis=0), cmap="gray")
right.imshow(np.where(mask, found.angle, np.nan), cmap="hsv", vmin=0, vmax=np.pi)
for axes, title in ((left, "all lights"), (right, "orientation")):
    axes.set(title=title, xticks=[], yticks=[])
Path("runs").mkdir(exist_ok=True)
figure.savefig("runs/orientation.png", dpi=100)

# %% [markdown]
# `method="auto"` uses light planes if the capture has a projector sweep, else the visual hull with
# the directions that single lights show. The tiny capture is reconstructed from every eighth light
# in coarse voxels.

# %%
model = Model("runs/example_model")
options = ReconstructOptions()
if tiny:
    capture = capture.view(lights=capture.olat_lights()[::8])
    options = ReconstructOptions(grid=8e-3, within=10e-3)
report = reconstruct(capture, model, method="auto", options=options)
strands = model.strands()
print(f"{len(strands)} strands, {strands.lengths().sum():.1f} m")
for stage in report.stages:
    for warning in stage.warnings:
        print(f"{stage.name}: {warning}")
