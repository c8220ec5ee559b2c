"""A run's page against the report of mujoco.sysid: size, time to open, and width on a phone.

    python benchmarks/reports.py
    python benchmarks/reports.py --runs emps go2 sts3215

Needs `pip install -e ".[sysid]"` and a Chromium. Both tools identify armature, damping and frictionloss of the twin
from one recording and write their reports. The mujoco.sysid report requests plotly from a server; the local copy
answers instead, so network time does not count. That report is written without videos.
"""

import argparse
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import absl.logging
import plotly
from measure import make_parser, report
from mujoco import sysid as mujoco_sysid
from omegaconf import OmegaConf
from playwright.sync_api import Browser, Page, Route, sync_playwright
from sysid import NAMES, Judge, pose, read_whole

from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.segments import cut_segments

PHONE, SCREEN = 390, 1440  # px
COLUMNS = {
    "page": "page",
    "megabytes": "size [MB]",
    "asked": "asks servers for",
    "loaded": "loaded [s]",
    "drawn": "first figure [s]",
    "figures": "figures",
    "height": f"height at {SCREEN} px",
    "width": f"width at {PHONE} px",
}
FIRST = "() => document.querySelector('.main-svg') !== null"
LOADED = "() => performance.getEntriesByType('navigation')[0].loadEventEnd / 1000"


def main() -> None:
    """Measure each page and report a table."""
    options = parse()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        pages = {"mujoco.sysid, twin": report_of_sysid(folder, options.samples, options.sequences)}
        pages["frictionzoo, twin"] = report_of_run(folder / "twin", options.samples)
        pages |= {f"frictionzoo, {run.name}": run.resolve() / "report.html" for run in options.runs}
        with sync_playwright() as driver:
            chromium = driver.chromium.launch(executable_path=find_chromium(), args=["--no-sandbox"])
            rows = [look(chromium, name, page, options.repeats) for name, page in pages.items()]
    report(options.out, rows, COLUMNS, samples=options.samples, sequences=options.sequences, repeats=options.repeats)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("reports", __doc__)
    parser.add_argument(
        "--runs", nargs="*", type=Path, default=[], metavar="FOLDER", help="runs whose pages are looked at"
    )
    parser.add_argument("--samples", type=int, default=40_000, help="samples of the twin's recording")
    parser.add_argument("--sequences", type=int, default=10, help="stretches in the report of mujoco.sysid")
    parser.add_argument("--repeats", type=int, default=5, help="times that each is opened; the median counts")
    return parser.parse_args()


def find_chromium() -> str:
    """Return the path of the browser."""
    names = ("chromium", "chromium-browser", "google-chrome")
    if (found := next(filter(None, map(shutil.which, names)), None)) is None:
        raise SystemExit(f"no browser among {', '.join(names)} on the PATH; install one")
    return found


def report_of_run(folder: Path, samples: int) -> Path:
    """Return the page of a frictionzoo run."""
    command = [sys.executable, "-m", "frictionzoo.run", "model=mujoco_default", "data=twin", "fit=lm"]
    finished = subprocess.run(
        [*command, f"data.samples={samples}", f"hydra.run.dir={folder}"], capture_output=True, text=True
    )
    if finished.returncode not in (0, 3):  # 3: the fit did not identify the drive
        raise SystemExit(finished.stderr)
    return folder / "report.html"


def report_of_sysid(folder: Path, samples: int, count: int) -> Path:
    """Return the report of mujoco.sysid."""
    absl.logging.set_verbosity(absl.logging.ERROR)  # sysid warns that states are not model sensors
    settings: Any = OmegaConf.to_container(compose_config("model=mujoco_default", "data=twin"), resolve=True)
    bench, model = build(settings["bench"]), build(settings["model"], nv=1)
    log = read_whole(settings["data"], samples)
    segments = cut_segments([log], None, (log.samples - 1) // count)
    parameters, sequences, function = pose(bench, model, segments, Judge(bench, segments))
    start = parameters.copy()
    found, result = mujoco_sysid.optimize(parameters, function, "mujoco", verbose=False)
    assert set(NAMES) == set(found.keys())
    written = mujoco_sysid.default_report(
        models_sequences=[sequences],
        initial_params=start,
        opt_params=found,
        residual_fn=function,
        opt_result=result,
        generate_videos=False,
    )
    written.build()
    path = folder / "sysid.html"
    written.save(path)
    return path


def look(chromium: Browser, name: str, path: Path, repeats: int) -> dict[str, Any]:
    """Open one page several times, each time in a new window; return its row."""
    seen = [open_once(chromium, path) for _ in range(repeats)]
    found = {
        key: statistics.median(each[key] for each in seen) for key in ("loaded", "drawn", "figures", "height", "width")
    }
    return {"page": name, "megabytes": path.stat().st_size / 1e6, "asked": seen[0]["asked"], **found}


def open_once(chromium: Browser, path: Path) -> dict[str, Any]:
    """Measure a page on a screen, and its width on a phone."""
    page, asked = visit(chromium, path, SCREEN)
    found = {"asked": asked, "loaded": page.evaluate(LOADED)}
    page.wait_for_function(FIRST)
    found["drawn"] = page.evaluate("() => performance.now() / 1000")
    found["figures"] = page.evaluate("() => document.querySelectorAll('.js-plotly-plot, [data-figure]').length")
    found["height"] = page.evaluate("() => document.documentElement.scrollHeight")
    page.context.close()
    page, _ = visit(chromium, path, PHONE)
    page.wait_for_function(FIRST)
    found["width"] = page.evaluate("() => document.documentElement.scrollWidth")
    page.context.close()
    return found


def visit(chromium: Browser, path: Path, width: int) -> tuple[Page, int]:
    """Open a page in a new window of this width; return it with its number of server requests."""
    page, asked = chromium.new_context(viewport={"width": width, "height": 900}).new_page(), []

    def answer(route: Route) -> None:
        asked.append(route.request.url)
        library = Path(plotly.__file__).parent / "package_data" / "plotly.min.js"
        route.fulfill(path=library) if "plotly" in route.request.url else route.abort()

    page.route(lambda url: url.startswith("http"), answer)
    page.goto(path.as_uri(), wait_until="load")
    return page, len(asked)


if __name__ == "__main__":
    main()
