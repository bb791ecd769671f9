# SPDX-License-Identifier: Apache-2.0
"""Measure the time to the first picture on the viewer's page, and pictures per second while the camera moves.

`clsplat view` serves a run, a model file, or a synthetic model of --gaussians. A headless Chromium without a GPU opens
the page, and draws it on the same cores. Times are from the request for the page until a picture is passed to WebGL.
Also prints the time until viser's page has its canvas, before the page connects to the server. Needs the extras `view`
and `test` (playwright), and a chromium on the path (Debian: apt install chromium).
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

import measuring
import numpy as np
from needs import chromium_path
from scenes import make_gaussians
from viewer_browser import clsplat

from clsplat.device.selection import open_device
from clsplat.gaussians import Gaussians
from clsplat.runs.run import model_file

WINDOW = {"width": 1280, "height": 720}
TURN = 3.0
"""Number of seconds for which the camera moves."""
FLAGS = {
    "mesa": ("--use-angle=gl-egl", "--ignore-gpu-blocklist"),
    "swiftshader": ("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
}
"""Chromium's flags for WebGL on the CPU, by name: the system's llvmpipe, or the library that comes with
Chromium."""
PLAIN = "--webgl-antialiasing-mode=none"
"""Chromium's flag against antialiasing in WebGL, which is slow on a CPU."""
WATCH = """
window.pictures = [];
for (const kind of [WebGL2RenderingContext, WebGLRenderingContext])
  for (const name of ["texImage2D", "texSubImage2D"]) {
    const usual = kind.prototype[name];
    kind.prototype[name] = function (...given) {
      const last = given[given.length - 1];
      if (last instanceof HTMLImageElement || last instanceof ImageBitmap)
        window.pictures.push([performance.now(), last.width, last.height]);
      return usual.apply(this, given);
    };
  }
window.drawn = null;
new MutationObserver(() => {
  if (window.drawn === null && document.querySelector("canvas")) window.drawn = performance.now();
}).observe(document, {childList: true, subtree: true});
"""


def made_up(count: int) -> Gaussians:
    """A model of `count` random Gaussians in a ball of radius 1, with SH of degree 3.

    They are about as large as those of a trained model of so many Gaussians.
    """
    rng = np.random.default_rng(0)
    means = rng.normal(size=(count, 3))
    means *= (rng.uniform(0.05, 1, count) ** (1 / 3) / np.linalg.norm(means, axis=1))[:, None]
    sh = rng.normal(0, 0.05, (count, 16, 3))
    sh[:, 0] = rng.uniform(-1.5, 1.5, (count, 3))
    sizes = np.log(rng.uniform(0.3, 1.5, (count, 3)) * count ** (-1 / 3))
    return make_gaussians(means, rng.normal(size=(count, 4)), sizes, 1 / (1 + np.exp(-rng.normal(0, 2, count))), sh)


def processor_seconds(process: int) -> float:
    """CPU time of the process with this number and of its running descendants, on Linux; 0 on other systems."""
    used, parents = {}, {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            words = stat.read_text().rsplit(")", 1)[1].split()
        except OSError:  # the process has just ended
            continue
        number = int(stat.parent.name)
        parents[number], used[number] = int(words[1]), (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
    family = {process}
    while more := {child for child, parent in parents.items() if parent in family} - family:
        family |= more
    return sum(used.get(each, 0.0) for each in family)


def visit(browser: Any, url: str, server: int) -> dict[str, float]:
    """Open the page once, move its camera, and return the measurements. server: number of the server's process."""
    page = browser.new_page(viewport=WINDOW)
    page.add_init_script(WATCH)
    page.goto(url, wait_until="commit")
    page.wait_for_function("window.pictures.length > 0", timeout=60_000, polling=20)
    first = page.evaluate("window.pictures[0][0]")
    drawn = page.evaluate("window.drawn")
    page.wait_for_timeout(2500)  # for the exact picture, and for the page to settle
    widths = [width for _, width, _ in page.evaluate("window.pictures")]
    page.mouse.click(300, 300)
    server_before, before_all = processor_seconds(server), processor_seconds(os.getpid())
    before, start = page.evaluate("[window.pictures.length, performance.now()]")
    page.keyboard.down("ArrowLeft")  # turns the camera in every frame; a mouse's moves would wait for the page
    page.wait_for_timeout(1000 * TURN)
    end, moved = page.evaluate("[performance.now(), window.pictures]")
    served, used = processor_seconds(server) - server_before, processor_seconds(os.getpid()) - before_all
    page.keyboard.up("ArrowLeft")
    page.close()
    count = max(len(moved) - before, 1)
    sizes = [width for _, width, _ in moved[before:]]
    return {
        "canvas_s": drawn / 1000,
        "first_s": first / 1000,
        "exact_width": max(widths),
        "moving_per_s": 1000 * (len(moved) - before) / (end - start),
        "server_ms": 1000 * served / count,
        "browser_ms": 1000 * (used - served) / count,
        "moving_width": statistics.median(sizes) if sizes else 0,
    }


def bench(model: Path, device: str | None, repeat: int, flags: tuple[str, ...]) -> list[dict[str, float]]:
    """Measurements of `repeat` visits to the page, after a warm-up visit. flags: Chromium's, for WebGL."""
    from playwright.sync_api import sync_playwright

    path = chromium_path()
    measuring.require(path is not None, "no chromium on the path, expected Debian's: apt install chromium")
    words = ("view", str(model), *(("--device", device) if device else ()))
    with clsplat(*words) as (url, server), sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", "--use-gl=angle", *flags])
        visit(browser, url, server.pid)  # warms up the browser
        found = [visit(browser, url, server.pid) for _ in range(repeat)]
        browser.close()
    return found


@measuring.tool("bench_viewer")
def main(arguments: Sequence[str]) -> int:
    """Run the measurement and print its results."""
    parser = measuring.options_parser(__doc__)
    parser.add_argument("model", metavar="RUN|MODEL.ply", type=Path, nargs="?")
    parser.add_argument("--gaussians", type=measuring.number, default=100_000)
    parser.add_argument("--webgl", choices=FLAGS, default="mesa", help="what draws the page without a GPU")
    parser.add_argument("--antialiasing", action="store_true", help="as browsers are by default")
    options = measuring.parsed(parser, arguments)
    flags = FLAGS[options.webgl] if options.antialiasing else (*FLAGS[options.webgl], PLAIN)
    with tempfile.TemporaryDirectory() as folder:
        model = options.model
        if model is None:
            model = Path(folder) / "model.ply"
            made_up(options.gaussians).save(model)
        count = len(Gaussians.load(model_file(model)))
        visits = bench(model, options.device, options.repeat, flags)
    medians = {name: statistics.median(each[name] for each in visits) for name in visits[0]}
    device = open_device(options.device)
    result = {
        **measuring.machine(device, options.repeat),
        "gaussians": count,
        "flags": flags,
        "visits": visits,
        **medians,
    }
    first, moving = (", ".join(f"{each[name]:.2f}" for each in visits) for name in ("first_s", "moving_per_s"))
    lines = [
        f"{count:,} Gaussians on a page of {WINDOW['width']} x {WINDOW['height']}, Chromium {' '.join(flags)}",
        f"page has a canvas  {medians['canvas_s']:6.2f} s after it was asked for",
        f"first picture      {medians['first_s']:6.2f} s ({first})",
        f"moving             {medians['moving_per_s']:6.2f} pictures a second ({moving})",
        f"                   {medians['moving_width']:6.0f} pixels wide",
        f"a picture's share  {medians['server_ms']:6.0f} ms of the processor in the server",
        f"                   {medians['browser_ms']:6.0f} ms in the browser, without a GPU",
    ]
    measuring.show(result, lines, as_json=options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
