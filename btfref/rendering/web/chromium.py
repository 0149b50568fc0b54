"""Chromium without a window, driven through its DevTools protocol over a pipe: no port, no package, no download.

Messages are JSON ended by NUL, on the descriptors 3 (to Chromium) and 4 (from it); the browser ends when the pipe does.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from typing import Any

from btfref.errors import BtfrefError, MissingDependencyError
from btfref.system import CHROMIUM, chromium, mend_command
from btfref.types import Facts

#: How the browser is started. WebGL 2 is drawn by SwiftShader, which is the same on every machine: since version 144
#: Chromium falls back to it only where `--enable-unsafe-swiftshader` says so ("unsafe": it compiles code of pages;
#: only pages of ours are shown).
FLAGS = (
    "--headless",
    "--remote-debugging-pipe",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    "--no-first-run",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-extensions",
    "--disable-sync",
    "--hide-scrollbars",
)

#: Seconds without an answer after which a browser counts as hanging.
TIMEOUT = 300.0

#: Longest message, bytes: after one of more than 100 MiB Chromium hears nothing any more, and does not say so.
LONGEST = 96 << 20

#: Characters of an expression's data that are said at a time.
PIECE = 32 << 20

#: Puts the two ends of the pipe where Chromium looks for them, then becomes it.
_START = "import os, sys; a = sys.argv; os.dup2(int(a[1]), 3); os.dup2(int(a[2]), 4); os.execv(a[3], a[3:])"


class Browser:
    """A running Chromium; a context manager.

    Parameters
    ----------
    flags : sequence of str
        Beside, or in place of some of, :data:`FLAGS`: later ones count.
    timeout : float
        Seconds that one answer may take.

    Attributes
    ----------
    profile : str
        Folder of its own, which goes when it ends.

    Raises
    ------
    MissingDependencyError
        Without Chromium.
    BtfrefError
        When it does not start.
    """

    def __init__(self, flags: tuple[str, ...] = (), *, timeout: float = TIMEOUT) -> None:
        program = chromium()
        if program is None:
            raise MissingDependencyError(
                "Chromium is not on this machine", f"run: {mend_command([CHROMIUM])}"
            )
        self.timeout, self._last, self._rest = timeout, 0, b""
        self.events: list[Facts] = []
        #: Whether an answer did not come in time: nobody knows what it is at.
        self.silent = False
        self._crashed: set[str | None] = set()
        self.profile = tempfile.mkdtemp(prefix="btfref-chromium-")
        ours, theirs = _pipe(), _pipe()
        try:
            self._process = subprocess.Popen(
                [
                    *(sys.executable, "-I", "-S", "-c", _START, str(ours[0]), str(theirs[1]), program),
                    *FLAGS,
                    f"--user-data-dir={self.profile}",
                    *flags,
                    "about:blank",
                ],
                pass_fds=(ours[0], theirs[1]),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        finally:
            os.close(ours[0])
            os.close(theirs[1])
        self._write, self._read = ours[1], theirs[0]
        os.set_blocking(self._write, False)
        try:
            self.version = str(self.send("Browser.getVersion")["product"])
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def closed(self) -> bool:
        """Whether it was closed, or has ended."""
        return self._write < 0 or self._process.poll() is not None

    def close(self) -> None:
        """End the browser and remove its profile; a second time does nothing."""
        if self._write < 0:
            return
        os.close(self._write)
        os.close(self._read)
        self._write = self._read = -1
        if self.silent:
            self._process.kill()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        shutil.rmtree(self.profile, ignore_errors=True)

    def send(self, method: str, parameters: Facts | None = None, session: str | None = None) -> Facts:
        """One command of the protocol, and its answer; events that come meanwhile are kept in ``events``.

        Raises
        ------
        BtfrefError
            When the command fails, the browser or page is gone, or there is no answer in time.
        """
        if self._write < 0:
            raise BtfrefError(f"the browser is closed; {method}")
        if session in self._crashed:
            raise BtfrefError(f"the browser's page crashed; {method}")
        self._last += 1
        message: Facts = {"id": self._last, "method": method, "params": parameters or {}}
        if session is not None:
            message["sessionId"] = session
        data = json.dumps(message).encode() + b"\0"
        if len(data) > LONGEST:
            raise BtfrefError(f"a message of {len(data)} bytes is too long for the browser; {method}")
        deadline = time.monotonic() + self.timeout
        self._put(data, method, deadline)
        while True:
            answer = self._take(method, deadline)
            if answer.get("id") == self._last:
                if "error" in answer:
                    raise BtfrefError(f"the browser refused {method}: {answer['error'].get('message')}")
                return answer["result"]
            if "method" in answer:
                self.events.append(answer)
                if answer["method"] == "Inspector.targetCrashed":
                    self._crashed.add(answer["sessionId"])
                # A crashed page never answers.
                if session in self._crashed:
                    raise BtfrefError(f"the browser's page crashed; {method}")

    def _put(self, data: bytes, method: str, deadline: float) -> None:
        rest = memoryview(data)
        while rest:
            # What the browser says meanwhile must be read, or both sides would wait.
            readable, writable, _ = select.select([self._read], [self._write], [], 1.0)
            if readable:
                self._receive(method)
            if writable:
                try:
                    rest = rest[os.write(self._write, rest[:65536]) :]
                except BlockingIOError:
                    continue
                except BrokenPipeError as error:
                    raise BtfrefError(f"the browser ended; {method}") from error
            if time.monotonic() > deadline:
                self.silent = True
                raise BtfrefError(f"the browser took no message for {self.timeout:g} s; {method}")

    def _receive(self, method: str) -> None:
        chunk = os.read(self._read, 1 << 20)
        if not chunk:
            raise BtfrefError(f"the browser ended; {method}")
        self._rest += chunk

    def _take(self, method: str, deadline: float) -> Facts:
        parts: list[bytes] = []
        while True:
            head, end, self._rest = self._rest.partition(b"\0")
            parts.append(head)
            if end:
                return json.loads(b"".join(parts))
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([self._read], [], [], left)[0]:
                self.silent = True
                raise BtfrefError(f"no answer from the browser within {self.timeout:g} s; {method}")
            self._receive(method)

    def page(self, url: str = "about:blank") -> Page:
        """A new page, loaded."""
        return Page(self, url)


class Page:
    """A page of a browser.

    Parameters
    ----------
    browser : Browser
    url : str
    """

    def __init__(self, browser: Browser, url: str) -> None:
        self.browser, self._given = browser, 0
        self._target = browser.send("Target.createTarget", {"url": "about:blank"})["targetId"]
        attached = browser.send("Target.attachToTarget", {"targetId": self._target, "flatten": True})
        self.session = attached["sessionId"]
        for domain in ("Runtime", "Page", "Log", "Inspector"):
            self.send(f"{domain}.enable")
        if url != "about:blank":
            self.go(url)

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the page."""
        with contextlib.suppress(BtfrefError):
            self.browser.send("Target.closeTarget", {"targetId": self._target})

    def send(self, method: str, parameters: Facts | None = None) -> Facts:
        """One command of the protocol for this page; see :meth:`Browser.send`."""
        return self.browser.send(method, parameters, self.session)

    def go(self, url: str) -> None:
        """Load another page, and wait for it.

        Raises
        ------
        BtfrefError
            When it cannot be loaded.
        """
        found = self.send("Page.navigate", {"url": url})
        if "errorText" in found:
            raise BtfrefError(f"the browser cannot load {url}: {found['errorText']}")
        loaded = "document.readyState === 'complete' || new Promise(done => addEventListener('load', () => done(true)))"
        self.evaluate(loaded)

    def evaluate(self, expression: str) -> Any:
        """The value of an expression of JavaScript, as JSON gives it; a promise is waited for.

        Raises
        ------
        BtfrefError
            With the message of what the expression throws.
        """
        asked = {"expression": expression, "awaitPromise": True, "returnByValue": True}
        found = self.send("Runtime.evaluate", asked)
        if "exceptionDetails" in found:
            details = found["exceptionDetails"]
            said = details.get("exception", {}).get("description") or details.get("text", "")
            raise BtfrefError(f"in the browser: {' '.join(str(said).splitlines()[0].split())}")
        return found["result"].get("value")

    def given(self, value: object) -> str:
        """An expression of JavaScript for a value of any size: what is large is said in pieces before.

        Parameters
        ----------
        value
            JSON-able.

        Returns
        -------
        str
            To be evaluated once.

        Raises
        ------
        BtfrefError
        """
        text = json.dumps(value)
        if len(text) <= PIECE:
            return text
        self._given += 1
        name = f"btfrefGiven{self._given}"
        self.evaluate(f"globalThis.{name} = []; 0")
        for first in range(0, len(text), PIECE):
            self.evaluate(f"{name}.push({json.dumps(text[first : first + PIECE])}); 0")
        return f"JSON.parse({name}.splice(0).join(''))"

    def taken(self, data: bytes | memoryview) -> str:
        """Give the page bytes of any size, by way of a file that it opens: text of them would take many times as long.

        Parameters
        ----------
        data : bytes-like

        Returns
        -------
        str
            An expression for a ``Uint8Array`` of them, to be evaluated once.

        Raises
        ------
        BtfrefError
        """
        self._given += 1
        name = f"btfrefGiven{self._given}"
        made = "Object.assign(document.createElement('input'), { type: 'file' })"
        found = self.send("Runtime.evaluate", {"expression": made})["result"]["objectId"]
        read = (
            "async function (name) { globalThis[name] = new Uint8Array(await this.files[0].arrayBuffer()); }"
        )
        with tempfile.NamedTemporaryFile(dir=self.browser.profile) as file:
            file.write(data)
            file.flush()
            self.send("DOM.setFileInputFiles", {"files": [file.name], "objectId": found})
            asked = {"objectId": found, "functionDeclaration": read, "arguments": [{"value": name}]}
            answer = self.send("Runtime.callFunctionOn", {**asked, "awaitPromise": True})
        if "exceptionDetails" in answer:
            raise BtfrefError(f"the browser cannot read what it is given: {len(data)} bytes")
        self.send("Runtime.releaseObject", {"objectId": found})
        return f"(() => {{ const bytes = {name}; delete globalThis.{name}; return bytes; }})()"

    def complaints(self) -> list[str]:
        """Errors and warnings of this page so far: of its console, of exceptions, of the browser's log."""
        said = []
        for event in self.browser.events:
            if event.get("sessionId") != self.session:
                continue
            name, values = event["method"], event["params"]
            if name == "Runtime.exceptionThrown":
                details = values["exceptionDetails"]
                said.append(details.get("exception", {}).get("description", details.get("text", "")))
            elif name == "Runtime.consoleAPICalled" and values["type"] in ("error", "warning", "assert"):
                said.append(" ".join(str(a.get("value", a.get("description"))) for a in values["args"]))
            elif name == "Log.entryAdded" and values["entry"]["level"] in ("error", "warning"):
                said.append(values["entry"]["text"])
        return said


def _pipe() -> tuple[int, int]:
    """Both ends of a pipe, away from the numbers 3 and 4 that the browser is to have."""
    found = []
    for end in os.pipe():
        found.append(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10))
        os.close(end)
    return found[0], found[1]


_shared: list[Browser] = []


def shared() -> Browser:
    """The process's browser, started when it is first asked for and closed with the process.

    One that was closed, or did not answer in time, makes room for another.
    """
    if _shared and (_shared[0].silent or _shared[0].closed):
        _shared.pop().close()
    if not _shared:
        browser = Browser()
        atexit.register(browser.close)
        _shared.append(browser)
    return _shared[0]
