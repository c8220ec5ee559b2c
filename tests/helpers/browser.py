"""Pages as a real browser shows them: one Chromium for all tests of a worker."""

import atexit
import base64
import gzip
import json
import re
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import sync_playwright

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the PATH")

# What scripts below may use: elements that are shown, whether plotly has drawn into one, and a wait for something.
TOOLS = """
const pause = time => new Promise(resolve => setTimeout(resolve, time));
const until = async (holds, times = 400) => { while (times-- && !holds()) await pause(25); return holds(); };
const shown = () => [...document.querySelectorAll("[data-figure]")]
  .filter(canvas => canvas.clientWidth && !canvas.closest("details:not([open])"));
const isDrawn = canvas => canvas.querySelector(".main-svg path.js-line, .main-svg .point path, .main-svg .points path");
const allDrawn = () => until(() => shown().every(isDrawn));
const brightness = color => color.match(/\\d+/g).slice(0, 3).reduce((sum, part) => sum + Number(part), 0);
const isDark = () => brightness(getComputedStyle(document.body).backgroundColor)
  < brightness(shown()[0].querySelector(".xtick text").style.fill);
"""
DRAWN = "return await allDrawn() ? shown().length : 0;"  # how many figures there are, if all are drawn
CLIPPED = """return [...document.querySelectorAll(".box")]
  .filter(box => box.clientWidth && box.scrollWidth > box.clientWidth + 1).map(box => box.textContent);"""
WIDTHS = """await allDrawn();
  return [innerWidth, document.documentElement.scrollWidth,
    ...shown().flatMap(canvas => [...canvas.querySelectorAll(".main-svg")])
      .map(svg => Math.ceil(svg.getBoundingClientRect().right))];"""

_SLOW = "GPU stall due to ReadPixels"  # what a browser without a GPU says of every picture in space


def read_data(source: str) -> dict[str, Any]:
    """What a page hands to its script: `figures`, `dark` and `state`."""
    packed = re.search(r'<script type="text/plain" id="figures">(.*?)</script>', source, re.S)
    assert packed
    return json.loads(gzip.decompress(base64.b64decode(packed[1])))


class Browser:
    """A headless Chromium with one page; `console` has what it wrote there, and the errors that it met."""

    def __init__(self) -> None:
        driver = sync_playwright().start()
        atexit.register(driver.stop)
        options = ["--no-sandbox", "--enable-unsafe-swiftshader"]
        self._page = driver.chromium.launch(executable_path=CHROMIUM, args=options).new_page()
        self.console: list[str] = []
        self._page.on("console", lambda message: _SLOW in message.text or self.console.append(message.text))
        self._page.on("pageerror", lambda error: self.console.append(str(error)))

    def show(self, path: Path, fragment: str = "", width: int = 1280, scheme: str = "light") -> None:
        """Opens a file in a window that is so wide, where the user prefers this colour scheme."""
        self._page.set_viewport_size({"width": width, "height": 900})
        self.prefer(scheme)
        self._page.goto("about:blank")  # a fragment alone would not load the page again
        self.console.clear()
        self._page.goto(path.as_uri() + fragment)

    def prefer(self, scheme: Any) -> None:
        """Of colours: `dark` or `light`."""
        self._page.emulate_media(color_scheme=scheme)

    def run(self, script: str) -> Any:
        """What a script returns, which may wait; it fails where the page has complained of anything."""
        answer = self._page.evaluate(f"(async () => {{ {TOOLS} {script} }})()")
        assert self.console == []
        return answer


start = cache(Browser)


def open_page(path: Path, **looks: Any) -> Browser:
    """This worker's browser with this file in it; `looks` are those of `Browser.show`."""
    start().show(path, **looks)
    return start()
