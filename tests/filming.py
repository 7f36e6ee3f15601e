"""Screenshots of a page, each of them checked: what is cut off or covered, what shines too bright
beside a stage, and what axe reports."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import cv2
import numpy as np

SIZES = {"desk": (1280, 800), "tablet": (1024, 768), "upright": (768, 1024)}
BRIGHTEST = 0.03
"""Of a white screen's light, what a view may give: a stage's own lamps are some 1,000 lux."""
PATIENCE_MS = 600_000  # of a browser without a GPU, which lights thousands of strands

LOOKED_OVER = """() => {
  const wrong = [];
  const box = (x) => x.getBoundingClientRect();
  const seen = (x) => x.checkVisibility({ visibilityProperty: true }) && box(x).width > 1;
  const all = (what) => [...document.querySelectorAll(what)].filter(seen);
  const say = (what, x) => wrong.push(`${what}: ${x?.outerHTML.slice(0, 120)}`);
  if (document.documentElement.scrollWidth > innerWidth)
    say("beyond the screen", all("main *, header *").findLast((x) => box(x).right > innerWidth));
  for (const x of all("button.blackout")) {
    const { top, bottom, right } = box(x);
    if (top < 0 || bottom > innerHeight || right > innerWidth) say("out of sight", x);
  }
  const modal = document.querySelector("dialog[open], .black");
  for (const x of modal ? [] : all("button, a.button, nav a, input, select, textarea")) {
    const { left, right, top, bottom } = box(x);
    const over = document.elementFromPoint((left + right) / 2, (top + bottom) / 2);
    if (!over || x.contains(over) || over.contains(x)) continue;
    // what is scrolled away lies under what stays, or out of its own box
    const stays = over.closest("#top, .scrub") ?? x.closest(".list, .wide, aside");
    if (!stays || over.closest("#top")?.contains(x)) say(`under ${over.outerHTML.slice(0, 60)}`, x);
  }
  for (const x of all("button, a.button, nav a, dd, th, td, figcaption, select, h1, h2, p"))
    if (getComputedStyle(x).display !== "inline" && x.scrollWidth > x.clientWidth + 1)
      say("cut off", x);
  return wrong;
}"""
SETTLED = "() => new Promise((on) => requestAnimationFrame(() => setTimeout(on, 60)))"


class Film:
    """Screenshots of one page after the other, and what is wrong with them."""

    def __init__(self, folder: Path, axe: Any) -> None:
        self.folder, self._axe = folder, axe
        self.wrong: list[str] = []
        self._taken = 0

    def take(
        self,
        page: Any,
        name: str,
        *,
        brightest: float = BRIGHTEST,
        drawn: str | None = None,
        sizes: Collection[str] = SIZES,
    ) -> None:
        """A picture of it at each size, when `drawn` holds; the page is left at the first one."""
        self._taken += 1
        for size, (width, height) in SIZES.items():
            if size not in sizes:
                continue
            page.set_viewport_size({"width": width, "height": height})
            page.evaluate(SETTLED)
            if drawn:
                page.wait_for_function(drawn, timeout=PATIENCE_MS)
            picture = page.screenshot(
                path=self.folder / f"{self._taken:02d}_{name}_{size}.png", animations="disabled"
            )
            findings = [*page.evaluate(LOOKED_OVER)]
            if (light := luminance(picture)) > brightest:
                findings.append(f"{100 * light:.1f} % of a white screen's light")
            if size != "tablet":
                for found in self._axe.run(page).response["violations"]:
                    nodes = [node["html"][:90] for node in found["nodes"]]
                    findings.append(
                        f"axe {found['impact']} {found['id']} {len(nodes)}: {nodes[:3]}"
                    )
            self.wrong += [f"{name}, {size}: {text}" for text in findings]
        page.set_viewport_size(dict(zip(("width", "height"), SIZES["desk"], strict=True)))


def luminance(png: bytes) -> float:
    """The mean of a screenshot's light, by sRGB's curve and weights, of a white one's."""
    blue, green, red = np.moveaxis(cv2.imdecode(np.frombuffer(png, np.uint8), 1) / 255.0, -1, 0)
    linear = [
        np.where(x > 0.04045, ((x + 0.055) / 1.055) ** 2.4, x / 12.92) for x in (red, green, blue)
    ]
    return float(np.tensordot([0.2126, 0.7152, 0.0722], linear, 1).mean())
