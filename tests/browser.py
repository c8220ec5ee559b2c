"""Pages as a real browser shows them: one Chromium for all tests of a worker, spoken to over its DevTools protocol."""

import atexit
import itertools
import json
import os
import select
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the PATH")

# What scripts below may use: elements that are shown, whether plotly has drawn into one, and a wait for something.
TOOLS = """
const pause = time => new Promise(resolve => setTimeout(resolve, time));
const until = async (holds, times = 400) => { while (times-- && !holds()) await pause(25); return holds(); };
const shown = () => [...document.querySelectorAll("[data-figure]")].filter(canvas => canvas.clientWidth);
const isDrawn = canvas => canvas.querySelector(".main-svg path.js-line, .main-svg .point path, .main-svg .points path");
const allDrawn = () => until(() => shown().every(isDrawn));
const brightness = color => color.match(/\\d+/g).slice(0, 3).reduce((sum, part) => sum + Number(part), 0);
const isDark = () => brightness(getComputedStyle(document.body).backgroundColor)
  < brightness(shown()[0].querySelector(".xtick text").style.fill);
"""
DRAWN = "return await allDrawn() ? shown().length : 0;"  # how many figures there are, if all are drawn
WIDTHS = """await allDrawn();
  return [innerWidth, document.documentElement.scrollWidth,
    ...[...document.querySelectorAll(".main-svg")].map(svg => Math.ceil(svg.getBoundingClientRect().right))];"""


class Browser:
    """A headless Chromium with one page.

    Attributes:
        console: What the page has written to its console, and which errors it has met.
    """

    def __init__(self) -> None:
        self.console: list[Any] = []
        self._numbers, self._loaded, self._buffer = itertools.count(), False, b""
        self._profile = tempfile.mkdtemp()
        (theirs, self._to), (self._from, answers) = os.pipe(), os.pipe()
        # The protocol's pipes are the descriptors 3 and 4.
        command = ["bash", "-c", f'exec "$0" "$@" 3<&{theirs} 4>&{answers}', str(CHROMIUM)]
        command += ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--remote-debugging-pipe"]
        command += [f"--user-data-dir={self._profile}", "about:blank"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen(command, pass_fds=(theirs, answers), **quiet)
        atexit.register(self.close)
        for end in (theirs, answers):
            os.close(end)
        self._session: dict[str, str] = {}
        (page,) = [target for target in self.send("Target.getTargets")["targetInfos"] if target["type"] == "page"]
        attached = self.send("Target.attachToTarget", targetId=page["targetId"], flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        for domain in ("Page", "Runtime", "Log"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **params: Any) -> Any:
        """The answer to a command."""
        number = next(self._numbers)
        command = {"id": number, "method": method, "params": params, **self._session}
        os.write(self._to, json.dumps(command).encode() + b"\0")
        while (message := self._read()).get("id") != number:
            pass
        assert "error" not in message, message
        return message["result"]

    def show(self, path: Path, fragment: str = "", width: int = 1280, scheme: str = "light") -> None:
        """Opens a file in a window that is so wide, where the user prefers this colour scheme."""
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
        self.prefer(scheme)
        for address in ("about:blank", path.as_uri() + fragment):  # a fragment alone would not load the page again
            self.console.clear()
            self._loaded = False
            self.send("Page.navigate", url=address)
            while not self._loaded:
                self._read()

    def prefer(self, scheme: str) -> None:
        """Of colours: `dark` or `light`."""
        self.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def run(self, script: str) -> Any:
        """What a script returns, which may wait; it fails where the page has complained of anything."""
        expression = f"(async () => {{ {TOOLS} {script} }})()"
        answer = self.send("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        assert self.console == []
        return answer["result"].get("value")

    def close(self) -> None:
        """Ends it."""
        self._process.kill()
        self._process.wait()
        shutil.rmtree(self._profile, ignore_errors=True)

    def _read(self) -> dict[str, Any]:
        """The next message; what the page complains of is kept."""
        while b"\0" not in self._buffer:
            assert select.select([self._from], [], [], 120)[0], "the browser does not answer"
            part = os.read(self._from, 1 << 20)
            assert part, "the browser has ended"
            self._buffer += part
        text, _, self._buffer = self._buffer.partition(b"\0")
        message = json.loads(text)
        self._loaded |= message.get("method") == "Page.loadEventFired"
        if message.get("method") in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"):
            self.console.append(message["params"])
        return message


start = cache(Browser)


def open_page(path: Path, **looks: Any) -> Browser:
    """This worker's browser with this file in it; `looks` are those of `Browser.show`."""
    start().show(path, **looks)
    return start()
