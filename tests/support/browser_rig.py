"""A real browser, told what to do by the DevTools protocol."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
from collections import deque
from pathlib import Path
from typing import Any

import pytest

LIMIT_S = 60.0
FIND = """(selector) => {
  const element = document.querySelector(selector);
  element.scrollIntoView({block: "center"});
  const box = element.getBoundingClientRect();
  return [box.left, box.top, box.width, box.height];
}"""
NAMES = ("chromium", "chromium-browser", "google-chrome")


class Browser:
    """A headless browser, told what to do by the DevTools protocol over pipes."""

    def __init__(self, folder: Path) -> None:
        (theirs_in, ours_out), (ours_in, theirs_out) = os.pipe(), os.pipe()
        # The browser reads from descriptor 3 and writes to 4. (Some shells know no descriptor above 9.)
        self._process = subprocess.Popen(
            ["bash", "-c", f'exec "$0" "$@" 3<&{theirs_in} 4>&{theirs_out}', browser(), "--headless", "--no-sandbox",
             "--disable-gpu", "--hide-scrollbars", "--remote-debugging-pipe", f"--user-data-dir={folder}"],
            pass_fds=(theirs_in, theirs_out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(theirs_in)
        os.close(theirs_out)
        self._out, self._in = os.fdopen(ours_out, "wb", 0), os.fdopen(ours_in, "rb", 0)
        self._rest, self._count, self._session = b"", 0, ""
        self._events: deque[dict[str, Any]] = deque()
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: object) -> dict[str, Any]:
        """What the browser answers to a command."""
        self._count += 1
        command: dict[str, object] = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            command["sessionId"] = self._session
        self._out.write(json.dumps(command).encode() + b"\0")
        while (message := self._next()).get("id") != self._count:
            self._events.append(message)
        assert "error" not in message, message
        found: dict[str, Any] = message["result"]
        return found

    def open(self, url: str, width: int, *, dark: bool = False, paper: bool = False) -> str:
        """Open a page; what it said on the console until it was loaded."""
        self.resize(width, dark=dark, paper=paper)
        self._events.clear()
        self.call("Page.navigate", url="about:blank")  # to a fragment alone no browser loads a page again
        self._wait_for_load()
        self.call("Page.navigate", url=url)
        self._wait_for_load()
        return self.read_console()

    def resize(self, width: int, *, dark: bool = False, paper: bool = False) -> None:
        """Set the width [pixels], the colours and the medium of the page."""
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.call("Emulation.setEmulatedMedia", media="print" if paper else "", features=scheme)
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=width < 600
        )

    def read_console(self) -> str:
        """What the page has said on the console since it was opened."""
        told = ("Log.entryAdded", "Runtime.consoleAPICalled", "Runtime.exceptionThrown")
        return "\n".join(json.dumps(event) for event in self._events if event.get("method") in told)

    def evaluate(self, expression: str) -> Any:
        """The value of an expression in the page; of a promise, once it is kept."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        return answer["result"].get("value")

    def click(self, selector: str, x: float | None = None, y: float | None = None) -> None:
        """Click an element with the mouse, in its middle or at a place from its upper left corner."""
        left, top, width, height = self.evaluate(f"({FIND})({json.dumps(selector)})")
        at = {"x": left + (width / 2 if x is None else x), "y": top + (height / 2 if y is None else y)}
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, **at)

    def picture(self) -> bytes:
        """The whole page, as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", captureBeyondViewport=True)["data"])

    def pdf(self) -> bytes:
        """The page that is open, on paper."""
        return base64.b64decode(self.call("Page.printToPDF", printBackground=True)["data"])

    def close(self) -> None:
        self._session = ""
        self.call("Browser.close")
        self._process.wait(LIMIT_S)
        self._out.close()
        self._in.close()

    def _wait_for_load(self) -> None:
        while not any(event.get("method") == "Page.loadEventFired" for event in self._events):
            self._events.append(self._next())
        self._events = deque(event for event in self._events if event.get("method") != "Page.loadEventFired")

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            some = self._in.read(1 << 20)
            assert some, "the browser has ended"
            self._rest += some
        text, _, self._rest = self._rest.partition(b"\0")
        message: dict[str, Any] = json.loads(text)
        return message


def browser() -> str:
    for name in NAMES:
        found = shutil.which(name)
        if found:
            return found
    pytest.fail(f"no browser: install one of {', '.join(NAMES)}")
