// A frame of each camera side by side, with exposure and overlays.

import { get, service } from "./api.js";
import { pressed } from "./blackout.js";
import { h, number, percent, setContent, svg } from "./dom.js";
import { S } from "./state.js";

/** Cells in `grid`, one per camera. `show(path, more)` shows the frame `path(camera)`. `more.query`: exposure options;
 * `words`: its label; `lacks`: cameras without a frame; `figures`: request histogram and focus; `over(camera)`: SVG
 * overlay in pixels. While a frame loads, only the newest request is kept. */
export function pictures(grid, signal) {
  const cells = new Map();
  service.addEventListener("yield", () => { for (const cell of cells.values()) cell.drop(); }, { signal });
  service.addEventListener("yielded", () => { for (const cell of cells.values()) if (cell.dropped) cell.show(() => cell.next.path, cell.next.more); }, { signal });
  grid.style.setProperty("--cell", S.rig.cameras.length > 12 ? "10rem" : "14rem");

  function cellOf(camera) {
    if (cells.has(camera.name)) return cells.get(camera.name);
    const { name, width, height } = camera;
    const image = h("img", { alt: "", width, height });
    const text = h("figcaption", name);
    const plot = svg("svg", { class: "histogram", viewBox: "0 0 64 20", preserveAspectRatio: "none", "aria-hidden": "true" });
    const drawn = svg("svg", { class: "over", viewBox: `-.5 -.5 ${width} ${height}`, "aria-hidden": "true" });
    const figure = h(`figure${width < 320 ? ".pixels" : ""}`, h(".shown", image, drawn), text);
    grid.append(figure);
    const cell = { busy: false, next: null, dropped: false, show, drop };
    cells.set(name, cell);
    return cell;

    /** Abort the download until "yielded". */
    function drop() {
      if (!cell.busy) return;
      cell.dropped = true;
      cell.busy = false;
      image.onload = image.onerror = null;
      image.removeAttribute("src");
    }

    function show(path, more) {
      cell.dropped = false;
      const next = { path: path(name), more };
      cell.next = next;
      if (pressed?.going) {
        cell.dropped = true;
        return;
      }
      if (more.lacks?.includes(name)) {
        image.removeAttribute("src");
        cell.busy = false; // removing `src` aborts the download without an event
        drawn.replaceChildren();
        plot.remove();
        setContent(text, `${name}: no frame`);
        return;
      }
      if (cell.busy) return; // `done` loads the newest request
      cell.busy = true;
      const done = () => { cell.busy = false; if (cell.next !== next) cell.show(() => cell.next.path, cell.next.more); };
      image.onload = done;
      image.onerror = () => { setContent(text, `${name}: no frame`); done(); };
      image.alt = `${name}, ${more.words}`;
      image.src = `.${next.path}.png?${[`size=${Math.min(Math.max(width, height), 480)}`, ...more.query].join("&")}`;
      setContent(text, name);
      drawn.replaceChildren(...(more.over?.(name) ?? []));
      if (more.figures) showFigures(next);
      else plot.remove();
    }

    async function showFigures(next) {
      const f = await get(`${next.path}.json`, { signal, yields: true }).catch(() => null);
      if (!f || cell.next !== next) return;
      const top = Math.log1p(Math.max(...f.histogram));
      plot.replaceChildren(...f.histogram.map((n, i) => svg("path", { class: i === 63 && f.saturated ? "full" : "", d: `M${i} 20V${(20 - (19 * Math.log1p(n)) / (top || 1)).toFixed(2)}h.9V20z` })));
      if (!plot.parentNode) figure.append(plot);
      setContent(text, `${name} · saturated ${percent(f.saturated)} · focus ${number(f.focus)} · 99.5 % at ${number(f.white)}`);
    }
  }

  return {
    show(path, more) { for (const camera of S.rig.cameras) cellOf(camera).show(path, more); },
    get busy() { return [...cells.values()].some((cell) => cell.busy); },
  };
}
