"""A real browser, told what to do over a pipe: Chromium, without a window."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import subprocess
import tempfile
import time
from typing import Any

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
_SECONDS = 60.0


class Browser:
    """One page of one browser; a context manager.

    Attributes:
        complaints: what the console has had to say: errors, warnings, refused content, uncaught exceptions.
    """

    def __init__(self) -> None:
        assert CHROMIUM is not None
        self.complaints: list[str] = []
        self._numbers = itertools.count(1)
        self._answers: dict[int, dict[str, Any]] = {}
        self._rest = b""
        self._profile = tempfile.TemporaryDirectory(prefix="v2v-browser-", ignore_cleanup_errors=True)
        theirs_in, self._ours_out = os.pipe()
        self._ours_in, theirs_out = os.pipe()

        def take_pipes() -> None:  # it reads descriptor 3 and writes descriptor 4
            first, second = os.dup(theirs_in), os.dup(theirs_out)
            os.dup2(first, 3)
            os.dup2(second, 4)

        self._process = subprocess.Popen(
            [
                *(CHROMIUM, "--headless=new", "--remote-debugging-pipe", "--no-first-run", "--disable-gpu"),
                *("--no-sandbox", "--disable-dev-shm-usage", f"--user-data-dir={self._profile.name}", "about:blank"),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            close_fds=False,
            preexec_fn=take_pipes,
            start_new_session=True,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        os.set_blocking(self._ours_in, False)
        targets = self._ask("Target.getTargets")["targetInfos"]
        page = next(each for each in targets if each["type"] == "page")
        self._session = self._ask("Target.attachToTarget", targetId=page["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self._tell(f"{domain}.enable")

    def open(self, address: str) -> None:
        """Goes there; what the console said before is forgotten."""
        for url in ("about:blank", address):  # blank between: the page before has nothing more to say then
            self.complaints.clear()
            self.value("window.isOld = true")
            self._tell("Page.navigate", url=url)
            self.until("!window.isOld && document.readyState === 'complete'")

    def value(self, expression: str) -> Any:
        """Of an expression of JavaScript, in the page."""
        found = self._tell("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def until(self, expression: str, seconds: float = _SECONDS) -> None:
        """Waits for it to be true in the page.

        Raises:
            TimeoutError: it never was; with what the page says.
        """
        deadline = time.monotonic() + seconds
        while not self.value(expression):
            if time.monotonic() > deadline:
                raise TimeoutError(f"{expression}: {self.value('document.body.innerText')[:2000]} {self.complaints}")
            time.sleep(0.05)

    def _tell(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._ask(method, session=self._session, **parameters)

    def _ask(self, method: str, *, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters} | ({"sessionId": session} if session else {})
        os.write(self._ours_out, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + _SECONDS
        while number not in self._answers:
            if time.monotonic() > deadline:
                raise TimeoutError(f"no answer to {method}")
            self._listen()
        answer = self._answers.pop(number)
        assert "error" not in answer, f"{method}: {answer.get('error')}"
        result: dict[str, Any] = answer["result"]
        return result

    def _listen(self) -> None:
        try:
            read = os.read(self._ours_in, 1 << 20)
        except BlockingIOError:
            time.sleep(0.005)
            return
        assert read, "the browser has ended"
        *messages, self._rest = (self._rest + read).split(b"\0")
        for message in map(json.loads, messages):
            if "id" in message:
                self._answers[message["id"]] = message
            elif message["method"] == "Runtime.exceptionThrown":
                self.complaints.append(str(message["params"]["exceptionDetails"]))
            elif message["method"] == "Log.entryAdded":
                entry = message["params"]["entry"]
                self.complaints.append(f"{entry['level']}: {entry['text']} {entry.get('url', '')}")
            elif message["method"] == "Runtime.consoleAPICalled" and message["params"]["type"] in ("error", "warning"):
                self.complaints.append(str(message["params"]["args"]))

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_error: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._ours_out)
        os.close(self._ours_in)
        self._profile.cleanup()
