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
# # Change the roughness and relight
#
# Render strands under an environment map with two roughnesses of the hair BSDF.
# Usage: `python examples/roughness.py [MODEL]`; without a fitted model, procedural strands.

# %%
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from tiny_capture import FIBRE, wig

from appearance import FittedModel, Sampling, build_scene, render_environment
from appearance.metrics.pictures import write_png
from appearance.metrics.scores import srgb
from appearance.render.environment_maps import studio
from reconstruction import Camera, Model

# %% [markdown]
# A fitted model has strands, a head, and the fibre's parameters; `beta_m` is the longitudinal
# roughness.

# %%
strands, head, hair = wig(), None, FIBRE
if len(sys.argv) > 1:
    fitted = FittedModel.load(Model(sys.argv[1]))
    strands, head, hair = fitted.strands, fitted.head, fitted.maps.mean()
size, paths = (256, 64) if len(sys.argv) > 1 else (48, 8)
camera = Camera.look_at("view", size, size, (0.45, -0.75, 0.2), (0, 0, 0), 18.0)

# %%
pictures = {}
for beta_m in (0.15, 0.5):
    scene = build_scene(strands, head, hair=replace(hair, beta_m=beta_m))
    pictures[beta_m] = render_environment(scene, camera, studio(64), Sampling(spp=paths))
    peak = np.percentile(pictures[beta_m], 99)
    print(f"beta_m {beta_m}: 99th percentile {peak:.3g} W/(sr m²)")

# %% [markdown]
# Both at one exposure: a smoother fibre has narrower and brighter highlights.

# %%
both = np.concatenate(list(pictures.values()), axis=1)
Path("runs").mkdir(exist_ok=True)
write_png(Path("runs/roughness.png"), srgb(both / np.percentile(both, 99)))
print("runs/roughness.png")
