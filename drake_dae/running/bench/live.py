"""Runs a loop in this process, while a person changes it in a browser."""

import errno
import json
import secrets
import threading
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import DrakeDaeError, ModelError
from drake_dae.running.bench.description import bench_of
from drake_dae.running.bench.page import page_of, title_of, web_text
from drake_dae.running.bench.run import HandRun, Sampler

HOST = "127.0.0.1"
"""The address of the server, which only programs on this machine reach."""

MOST_BYTES = 1_000_000
"""The largest size of a request."""

MOST_TICKS = 60
"""The largest number of ticks in a request."""

POLL_INTERVAL = 0.5
"""The time, in s, between two checks of an idle server whether it should end."""


class Server(ThreadingHTTPServer):
    """Serves the page of a bench to this machine, and runs its loop at the page's requests.

    The page's address contains a secret, so that no other page of the browser can reach it.

    Args:
        loop, context, config, title, notes: See `live`.
        save: Saves the run, and returns a text that the page shows.
        port: The port; 0 for any free port.

    Attributes:
        address: The address of the page.
        run: The present run.
        lock: The lock of the run.

    Raises:
        ModelError: The plant of a loop is not a robot, or a diagram has no vector output port.
        OSError: The port is in use.
    """

    daemon_threads = True

    def __init__(
        self,
        loop: ClosedLoop | Diagram,
        context: Context | None = None,
        config: SimulatorConfig | None = None,
        title: str = "",
        notes: Sequence[str] = (),
        save: Callable[[HandRun], str] | None = None,
        port: int = 0,
    ) -> None:
        if not 0 <= port <= 65535:
            raise ModelError(f"a port is a number from 0, for any, to 65535, got {port}")
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            text = f"port {port}: {error.strerror}"
            if error.errno == errno.EADDRINUSE:
                text = f"port {port} on this machine is in use: choose another, or 0 for any"
            raise OSError(error.errno, text) from None
        try:
            diagram = loop if isinstance(loop, Diagram) else loop.diagram
            context = diagram.CreateDefaultContext() if context is None else context
            bench = bench_of(loop, context, title or title_of(loop), notes)
            self._sampler = Sampler(bench)
            self._arguments = loop, context, config
            self._save, self.lock = save, threading.Lock()
            self.path = f"/{secrets.token_urlsafe(12)}/"
            self.address = f"http://{HOST}:{self.server_port}{self.path}"
            data = bench.data | {"kind": "live"}
            self.page = page_of(bench, data, [web_text("live.js")], "'self'")
            self.start()
        except BaseException:
            self.server_close()
            raise

    def start(self) -> dict[str, Any]:
        """Begins a new run; returns its first sample."""
        self.run = HandRun(*self._arguments)
        return {"samples": [self._sampler(self.run.context)]}

    def answer(self, request: str, data: Any) -> dict[str, Any]:
        """Returns the answer to a request of the page.

        Args:
            request: "start", "save" or "advance".
            data: For "advance", the number of "ticks", and "set", a list of (input, value).

        Raises:
            ModelError: There is no such request or input, or the data are wrong.
            DrakeDaeError: The loop cannot continue.
        """
        with self.lock:  # A browser opens several connections; each has its own thread.
            return self._answer(request, data)

    def _answer(self, request: str, data: Any) -> dict[str, Any]:
        if request == "start":
            return self.start()
        if request == "save" and self._save is not None:
            return {"saved": self._save(self.run)}
        if request != "advance":
            raise ModelError(f"a bench does not know '{request}'")
        try:
            changes = {int(index): float(value) for index, value in data["set"]}
            ticks = int(data["ticks"])
        except (TypeError, ValueError, KeyError):
            raise ModelError("a bench needs a number of ticks, and a list of changes") from None
        self.run.set(changes)
        samples = []
        for _ in range(min(ticks, MOST_TICKS)):
            self.run.advance()
            samples.append(self._sampler(self.run.context))
        return {"samples": samples}


class _Handler(BaseHTTPRequestHandler):
    """Answers the requests of the page."""

    protocol_version = "HTTP/1.1"
    server: Server

    def do_GET(self) -> None:
        if self._is_from_page(self.path == self.server.path):
            self._send(self.server.page.encode(), "text/html; charset=utf-8")

    def do_POST(self) -> None:
        if not self._is_from_page(self.path.startswith(self.server.path)):
            return
        size = int(self.headers.get("Content-Length") or 0)
        if not 0 <= size <= MOST_BYTES:
            self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
            return
        try:
            data = json.loads(self.rfile.read(size) or b"null")
            answer = self.server.answer(self.path.removeprefix(self.server.path), data)
        except (DrakeDaeError, RuntimeError, ValueError, OSError) as error:
            answer = {"error": " ".join(str(error).split())}
        self._send(json.dumps(answer).encode(), "application/json")

    def _is_from_page(self, has_secret: bool) -> bool:
        """Returns whether a request comes from the page; sends an error if it does not."""
        if has_secret and self.headers.get("Host") == f"{HOST}:{self.server.server_port}":
            return True
        self.send_error(HTTPStatus.NOT_FOUND)
        return False

    def _send(self, body: bytes, kind: str) -> None:
        with suppress(ConnectionError):  # The browser was closed.
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

    def log_message(self, *arguments: Any) -> None:
        """Prints nothing."""


@checked(ModelError)
def live(
    loop: ClosedLoop | Diagram,
    context: Context | None = None,
    config: SimulatorConfig | None = None,
    folder: str | Path = "live",
    title: str = "",
    notes: Sequence[str] = (),
    port: int = 0,
    *,
    opens: bool = True,
    tell: Callable[[str], None] = print,
    save: Callable[[HandRun], str] | None = None,
) -> None:
    """Runs a loop or diagram in real time, with a page in the browser to change it, until Ctrl-C.

    The page is that of `write_page`, but the loop runs in this process, by Drake's Simulator.
    Therefore it may contain parts that cannot be exported: Drake's own contact, contacts that open,
    tasks, and your own blocks. Only browsers on this machine reach the page. A change takes effect
    at the next multiple of 1/120 s. "save" writes the record and the commands; `replay` repeats
    such a run.

    `live` supports any diagram with a vector output port, see `write_page`. The page draws the
    bodies that its SceneGraph poses. Links of a MultibodyPlant can be pushed if its port
    `applied_spatial_force` has no connection.

    Args:
        loop, context, config, title, notes: See `write_page`. All settings of `config` apply,
            except the real-time rate.
        folder: The folder in which "save" writes record.npz and commands.json; it is created if
            necessary.
        port: The port; 0 for any free port.
        opens: Whether to open the page in a browser.
        tell: Prints a line.
        save: Saves a run, and returns a text that the page shows; None to save it in the folder.

    Raises:
        ModelError: The plant of a loop is not a robot, or a diagram has no vector output port.
        OSError: The port is in use.
    """

    def save_in_folder(run: HandRun) -> str:
        target = Path(folder)
        target.mkdir(parents=True, exist_ok=True)
        run.record().save(target / "record.npz")
        run.commands.save(target / "commands.json")
        return str(target)

    with Server(loop, context, config, title, notes, save or save_in_folder, port) as server:
        tell(f"{server.address}  (Ctrl-C ends it)")
        if opens:
            is_open = False
            with suppress(webbrowser.Error):
                is_open = webbrowser.open(server.address)
            if not is_open:
                tell("found no browser here; open this address in one on this machine")
        with suppress(KeyboardInterrupt):
            server.serve_forever(POLL_INTERVAL)
