"""A browser to test pages in: headless Chromium over its DevTools protocol."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    "--headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --no-first-run "
    "--disable-extensions --remote-debugging-port=0 --window-size=900,600"
).split()


class Page:
    """One open page: what it shows, what its console says, a mouse."""

    def __init__(self, socket) -> None:
        self._socket, self._number = socket, 0
        self.problems: list[str] = []

    def call(self, method: str, **parameters) -> dict:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=30))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer)

    def _note(self, event: dict) -> None:
        kind, values = event.get("method"), event.get("params", {})
        if kind == "Runtime.exceptionThrown":
            self.problems.append(str(values["exceptionDetails"].get("exception", values)))
        elif kind == "Runtime.consoleAPICalled" and values["type"] == "error":
            self.problems.append(" ".join(str(a.get("value", a.get("description"))) for a in values["args"]))
        elif kind == "Log.entryAdded" and values["entry"]["level"] == "error":
            self.problems.append(values["entry"]["text"] + " " + values["entry"].get("url", ""))

    def evaluate(self, expression: str):
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def screenshot(self) -> np.ndarray:
        """(H, W, 3) uint8 RGB."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]

    def drag(self, start: tuple[float, float], stop: tuple[float, float]) -> None:
        x, y = start
        self.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, button="left", clickCount=1)
        for k in range(1, 6):
            x, y = (a + (b - a) * k / 5 for a, b in zip(start, stop, strict=True))
            self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, button="left")
        self.call("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, button="left", clickCount=1)

    def settled(self, seconds: float = 40.0) -> np.ndarray:
        """A screenshot once the picture no longer changes."""
        last, since, limit = self.screenshot(), time.monotonic(), time.monotonic() + seconds
        while time.monotonic() < limit and time.monotonic() - since < 2.5:
            time.sleep(0.3)
            image = self.screenshot()
            if np.abs(image.astype(int) - last).mean() > 0.05:
                last, since = image, time.monotonic()
        return last


@contextmanager
def opened(url: str, folder: Path) -> Iterator[Page]:
    """Open a page and close the browser afterwards."""
    from websockets.sync.client import connect

    assert CHROMIUM is not None
    command = [CHROMIUM, *FLAGS, f"--user-data-dir={folder / 'profile'}", url]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        try:
            lines = (re.search(r"ws://[^/]*:(\d+)/", line) for line in process.stderr)
            port = next(found for found in lines if found).group(1)
            with connect(_page_address(port, url), max_size=None) as socket:
                page = Page(socket)
                for domain in ("Page", "Runtime", "Log"):  # the console's entries so far come along
                    page.call(f"{domain}.enable")
                yield page
        finally:
            process.kill()


def _page_address(port: str, url: str) -> str:
    limit = time.monotonic() + 20
    while time.monotonic() < limit:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as stream:
            for target in json.load(stream):
                if target["type"] == "page" and target["url"].startswith(url):
                    return target["webSocketDebuggerUrl"]
        time.sleep(0.2)
    raise AssertionError(f"{url} did not open")
