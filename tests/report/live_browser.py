"""Headless Chromium, driven by its DevTools protocol with real clock, mouse and keys.

https://chromedevtools.github.io/devtools-protocol/
"""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
import time

import pytest

_TIMEOUT = 120.0
"""Seconds after which the browser is killed."""


class LiveBrowser:
    """Context with one page in a browser; skips the test without Chromium."""

    def __init__(self, path, profile, *flags, size=(900, 1000)):
        command = shutil.which("chromium") or shutil.which("google-chrome")
        if command is None:
            pytest.skip("chromium is not installed")
        flags = [*flags, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"]
        flags += ["--disable-background-networking", f"--user-data-dir={profile}"]
        flags += [f"--window-size={size[0]},{size[1]}", "--force-device-scale-factor=1"]
        # It reads commands from descriptor 3 and answers at 4.
        shell = ["sh", "-c", 'exec "$@" 3<&0 4>&1 </dev/null >&2', "sh"]
        command = [*shell, command, *flags, "--remote-debugging-pipe"]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._end = threading.Timer(_TIMEOUT, self._process.kill)
        self._end.start()
        self._session, self._calls, self._dragging, self._events = {}, 0, False, []
        try:
            target = self.call("Target.createTarget", url="about:blank")["targetId"]
            attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
            self._session = {"sessionId": attached["sessionId"]}
            for domain in ("Runtime", "Log", "Page"):
                self.call(f"{domain}.enable")
            self.call("Page.navigate", url=path.as_uri())
            self.wait_until("document.readyState === 'complete' && location.href !== 'about:blank'")
        except BaseException:
            self.close()
            raise

    def __enter__(self):
        return self

    def __exit__(self, *raised):
        self.close()

    def close(self):
        self._end.cancel()
        self._process.kill()
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait()

    def call(self, method, **params):
        """Call a method of the protocol and return its result."""
        self._calls += 1
        message = {"id": self._calls, "method": method, "params": params, **self._session}
        self._process.stdin.write(json.dumps(message).encode() + b"\0")
        self._process.stdin.flush()
        while True:
            read = bytearray()
            while not read.endswith(b"\0"):
                byte = self._process.stdout.read(1)
                assert byte, "the browser ended"
                read += byte
            answer = json.loads(read[:-1])
            if answer.get("id") == self._calls:
                assert "error" not in answer, answer["error"]
                return answer["result"]
            self._events.append(answer)

    def value(self, expression):
        """Return the value of an expression in the page, after waiting for a promise."""
        options = {"returnByValue": True, "awaitPromise": True}
        result = self.call("Runtime.evaluate", expression=expression, **options)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def wait_until(self, condition, seconds=30.0):
        """Wait until an expression of the page, or a function of the test, is true."""
        limit = time.monotonic() + seconds
        while not (self.value(condition) if isinstance(condition, str) else condition()):
            assert time.monotonic() < limit, f"{condition} is not true; {self.errors()}"
            time.sleep(0.02)

    def mouse(self, *events):
        """Press, move or release the mouse: ("Pressed", x, y) in pixels."""
        for event, x, y in events:
            button = "none" if event == "Moved" and not self._dragging else "left"
            self._dragging = event == "Pressed" or (self._dragging and event == "Moved")
            state = {"button": button, "buttons": int(self._dragging), "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=f"mouse{event}", x=x, y=y, **state)

    def click(self, selector, across=0.5):
        """Click on an element, at a fraction of its width."""
        x, y = self.position(selector, across)
        self.mouse(("Pressed", x, y), ("Released", x, y))

    def position(self, selector, across=0.5):
        """Scroll to an element and return its position in pixels, at a fraction of its width."""
        return self.value(
            f"(() => {{ const element = document.querySelector({json.dumps(selector)});"
            "element.scrollIntoView({ block: 'center', behavior: 'instant' });"
            "const box = element.getBoundingClientRect();"
            f"return [box.left + {across} * box.width, box.top + box.height / 2]; }})()"
        )

    def press(self, key, code=0):
        """Press and release a key, by its name and its Windows key code."""
        text = {"text": key} if len(key) == 1 else {}
        for event in ({"type": "keyDown", **text}, {"type": "keyUp"}):
            self.call("Input.dispatchKeyEvent", key=key, windowsVirtualKeyCode=code, **event)

    def errors(self):
        """Return errors and warnings of the console."""
        self.value("0")  # earlier messages have then arrived
        messages = []
        for event in self._events:
            params = event["params"]
            level = params.get("type") or params.get("entry", {}).get("level")
            if "exceptionDetails" in params or level in ("error", "warning", "assert"):
                messages.append(json.dumps(params))
        return messages
