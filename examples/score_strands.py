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
# # Score strands of any method
#
# Compare a strand file with the truth: precision, recall and F, also at equal length.
# Usage: `python examples/score_strands.py PRED TRUE` (`.npz`, `.hair`, `.abc`, `.usd`, `.data`,
# `.tfx`); without files, jittered and thinned copies of procedural strands.

# %%
import sys
from dataclasses import replace

import numpy as np
from tiny_capture import wig

from reconstruction import Strands, read_strands
from reconstruction.evaluation.assessment import assess_strands

if len(sys.argv) > 2:
    true = read_strands(sys.argv[2])
    predictions = {sys.argv[1]: read_strands(sys.argv[1])}
else:
    true = wig(300)
    rng = np.random.default_rng(0)
    copies = [
        replace(true, points=true.points + rng.normal(0, 5e-4, true.points.shape).astype("f4"))
        for _ in range(3)
    ]
    count = len(true) // 2
    end = true.offsets[count]
    predictions = {
        "jitter of 0.5 mm": copies[0],
        "three jittered copies": Strands.from_list([line for c in copies for line in c]),
        "every second strand": Strands(true.points[:end], true.offsets[: count + 1], true.radius),
    }

# %% [markdown]
# Density buys recall, so F stands beside F at equal length.

# %%
for name, strands in predictions.items():
    figures = assess_strands(strands, true).figures
    print(f"{name}: {len(strands)} strands, {strands.lengths().sum():.0f} m")
    for threshold, scores in figures["all"].items():
        shown = ", ".join(f"{k} {100 * scores[k]:.1f} %" for k in ("precision", "recall", "f"))
        equal = figures["equal_length"]["all"][threshold]["f"]
        print(f"  {threshold}: {shown}; f at equal length {100 * equal:.1f} %")
