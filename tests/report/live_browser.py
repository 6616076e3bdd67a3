"""A headless browser whose clock, mouse and keys are real, driven by its DevTools protocol.

https://chromedevtools.github.io/devtools-protocol/
"""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

__all__ = ["LiveBrowser", "browser_command"]

_LONGEST = 120.0
"""Seconds after which the browser is killed, and what waits for it fails."""


def browser_command() -> str:
    """Return the browser's command; skip the test where there is none."""
    command = shutil.which("chromium") or shutil.which("google-chrome")
    if command is None:
        pytest.skip("there is no chromium to play the page in")
    return command


class LiveBrowser:
    """One page in a browser; a context.

    Parameters
    ----------
    path : Path
        The page.
    profile : Path
        Folder for the browser's own files.
    size : tuple of int
        Of the window, pixels.
    """

    def __init__(self, path: Path, profile: Path, size: tuple[int, int] = (900, 1000)) -> None:
        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"]
        flags += ["--disable-background-networking", f"--user-data-dir={profile}"]
        flags += [f"--window-size={size[0]},{size[1]}", "--force-device-scale-factor=1"]
        # It is told what to do at descriptor 3 and answers at 4.
        shell = ["sh", "-c", 'exec "$@" 3<&0 4>&1 </dev/null >&2', "sh"]
        self._process = subprocess.Popen(
            [*shell, browser_command(), *flags, "--remote-debugging-pipe"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        self._end = threading.Timer(_LONGEST, self._process.kill)
        self._end.start()
        self._session: str | None = None
        self._asked = 0
        self._held = False
        self._events: list[dict[str, Any]] = []
        try:
            target = self.ask("Target.createTarget", url="about:blank")["targetId"]
            held = self.ask("Target.attachToTarget", targetId=target, flatten=True)
            self._session = held["sessionId"]
            for domain in ("Runtime", "Log", "Page"):
                self.ask(f"{domain}.enable")
            self.ask("Page.navigate", url=path.as_uri())
            self.wait_until("document.readyState === 'complete' && location.href !== 'about:blank'")
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> LiveBrowser:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def close(self) -> None:
        """End the browser."""
        self._end.cancel()
        self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()
        self._process.wait()

    def ask(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result."""
        self._asked += 1
        message: dict[str, Any] = {"id": self._asked, "method": method, "params": params}
        if self._session is not None:
            message["sessionId"] = self._session
        pipes = self._process.stdin, self._process.stdout
        assert pipes[0] is not None
        assert pipes[1] is not None
        pipes[0].write(json.dumps(message).encode() + b"\0")
        pipes[0].flush()
        while True:
            read = bytearray()
            while not read.endswith(b"\0"):
                letter = pipes[1].read(1)
                assert letter, "the browser ended"
                read += letter
            said = json.loads(read[:-1])
            if said.get("id") == self._asked:
                assert "error" not in said, said["error"]
                return said["result"]
            self._events.append(said)

    def value(self, expression: str) -> Any:
        """Return what an expression is in the page; a promise is waited for."""
        found = self.ask(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait_until(self, condition: str | Callable[[], bool], seconds: float = 30.0) -> None:
        """Wait until an expression of the page, or a function of the test, is true."""
        limit = time.monotonic() + seconds
        while not (self.value(condition) if isinstance(condition, str) else condition()):
            assert time.monotonic() < limit, f"{condition} is not true; {self.errors()}"
            time.sleep(0.02)

    def mouse(self, *events: tuple[str, float, float]) -> None:
        """Press, move or release the mouse: names as ``"Pressed"``, pixels across and down."""
        for event, x, y in events:
            button = "none" if event == "Moved" and not self._held else "left"
            self._held = event == "Pressed" or (self._held and event == "Moved")
            held = {"button": button, "buttons": int(self._held), "clickCount": 1}
            self.ask("Input.dispatchMouseEvent", type=f"mouse{event}", x=x, y=y, **held)

    def click(self, selector: str, across: float = 0.5) -> None:
        """Click on an element, at a share of its width."""
        x, y = self.place(selector, across)
        self.mouse(("Pressed", x, y), ("Released", x, y))

    def place(self, selector: str, across: float = 0.5) -> tuple[float, float]:
        """Scroll to an element and return where it is, pixels, at a share of its width."""
        x, y = self.value(
            f"(() => {{ const found = document.querySelector({json.dumps(selector)});"
            "found.scrollIntoView({ block: 'center', behavior: 'instant' });"
            "const box = found.getBoundingClientRect();"
            f"return [box.left + {across} * box.width, box.top + box.height / 2]; }})()"
        )
        return x, y

    def press(self, key: str, code: int) -> None:
        """Press a key, by its name and its Windows key code, and let it go."""
        text = {"text": key} if len(key) == 1 else {}
        for event, held in (("keyDown", text), ("keyUp", {})):
            self.ask(
                "Input.dispatchKeyEvent", type=event, key=key, windowsVirtualKeyCode=code, **held
            )

    def screenshot(self) -> bytes:
        """Return what is seen, PNG."""
        return base64.b64decode(self.ask("Page.captureScreenshot")["data"])

    def errors(self) -> list[str]:
        """Return what the console says that is worse than information, in the words it came in."""
        self.value("0")  # what was said before has then arrived
        return [
            json.dumps(event["params"])
            for event in self._events
            if event["method"] == "Runtime.exceptionThrown"
            or (
                event["method"] == "Runtime.consoleAPICalled"
                and event["params"]["type"] in ("error", "warning", "assert")
            )
            or (
                event["method"] == "Log.entryAdded"
                and event["params"]["entry"]["level"] in ("error", "warning")
            )
        ]
