"""A real Chromium for tests of pages, driven over its debugging pipe: no port, no driver, no network."""

import base64
import json
import os
import shutil
import subprocess
import sys
import tempfile

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
LAUNCH = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(end), fcntl.F_DUPFD, 10) for end in sys.argv[1:3]]
os.dup2(ends[0], 3), os.dup2(ends[1], 4)
os.execv(sys.argv[3], sys.argv[3:])
"""


class Browser:
    """One page after the other: `show` loads it, and notes what it says and asks for."""

    def __init__(self):
        if CHROMIUM is None:
            pytest.skip("no Chromium on this machine: Debian's package is `chromium`")
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)  # it may still write
        (read, self._out), (self._in, write) = os.pipe(), os.pipe()
        options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--remote-debugging-pipe"]
        words = [CHROMIUM, *options, f"--user-data-dir={self._folder.name}", "about:blank"]
        launch = [sys.executable, "-c", LAUNCH, str(read), str(write), *words]
        self._process = subprocess.Popen(launch, pass_fds=(read, write), stderr=subprocess.DEVNULL)
        os.close(read), os.close(write)
        self._buffer, self._number, self._session, self.events = b"", 0, None, []
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    def _message(self):
        while b"\0" not in self._buffer:
            more = os.read(self._in, 1 << 20)
            assert more, "Chromium ended"
            self._buffer += more
        message, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(message)

    def ask(self, method, **params):
        """Send a command and wait for its answer."""
        self._number += 1
        command = {"id": self._number, "method": method, "params": params}
        command |= {"sessionId": self._session} if self._session else {}
        data = json.dumps(command).encode() + b"\0"
        while data:
            data = data[os.write(self._out, data) :]
        while True:
            message = self._message()
            if message.get("id") == self._number:
                assert "error" not in message, message
                return message["result"]
            self.events.append(message)

    def show(self, path, width=1280, dark=False, media="screen"):
        """Load a page at a width, and wait until it is there."""
        self.events.clear()
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.ask("Emulation.setEmulatedMedia", media=media, features=[scheme])
        self.ask("Page.navigate", url=path.as_uri())
        while not any(event["method"] == "Page.loadEventFired" for event in self.events):
            self.events.append(self._message())

    def evaluate(self, expression):
        """The value of an expression in the page."""
        answer = self.ask("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    @property
    def said(self):
        """What it logged: errors of its scripts, of its policy and of what it could not load."""
        kinds = ("Log.entryAdded", "Runtime.consoleAPICalled", "Runtime.exceptionThrown")
        return [event for event in self.events if event["method"] in kinds]

    @property
    def asked_for(self):
        """The addresses that it asked for, but for those that hold their own data."""
        requests = [event for event in self.events if event["method"] == "Network.requestWillBeSent"]
        addresses = [event["params"]["request"]["url"] for event in requests]
        return [address for address in addresses if not address.startswith("data:")]

    def printed(self):
        """The page as PDF."""
        return base64.b64decode(self.ask("Page.printToPDF")["data"])

    def close(self):
        self._process.kill()
        self._process.wait()
        os.close(self._in), os.close(self._out)
        self._folder.cleanup()
