"""A loop that runs in this process, while a person changes it in a browser."""

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
"""Nobody else reaches it."""

MOST = 1_000_000
"""The longest request, in bytes."""

MOST_TICKS = 60
"""The most ticks of a request."""

PATIENCE = 0.5
"""How often, in s, a server without requests looks whether it should end."""


class Server(ThreadingHTTPServer):
    """Serves the page of a bench to this machine, and runs its loop as the page asks.

    The page's address has a secret, so that no other page of the browser can reach it.

    Args:
        loop, context, config, title, notes: As of `live`.
        save: (run) -> what was saved, in words.
        port: The port; 0 for any that is free.

    Attributes:
        address: The address of the page.
        run: The present run.
        lock: Held while the run advances.

    Raises:
        ModelError: The plant is no robot.
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
            what = f"port {port} on this machine is in use: choose another, or 0 for any"
            text = what if error.errno == errno.EADDRINUSE else f"port {port}: {error.strerror}"
            raise OSError(error.errno, text) from None
        try:
            diagram = loop if isinstance(loop, Diagram) else loop.diagram
            context = diagram.CreateDefaultContext() if context is None else context
            bench = bench_of(loop, context, title or title_of(loop), notes)
            self._sampler = Sampler(bench)
            self._made = loop, context, config
            self._save, self.lock = save, threading.Lock()
            self.path = f"/{secrets.token_urlsafe(12)}/"
            self.address = f"http://{HOST}:{self.server_port}{self.path}"
            self.page = page_of(
                bench, bench.data | {"kind": "live"}, [web_text("live.js")], "'self'"
            )
            self.start()
        except BaseException:
            self.server_close()
            raise

    def start(self) -> dict[str, Any]:
        """Begins again."""
        self.run = HandRun(*self._made)
        return {"samples": [self._sampler(self.run.context)]}

    def answer(self, what: str, told: Any) -> dict[str, Any]:
        """What the page gets for a request.

        Raises:
            ModelError: It asks for what there is not.
            DrakeDaeError: The loop cannot go on.
        """
        with self.lock:  # A browser keeps several connections, each of which has a thread.
            return self._answer(what, told)

    def _answer(self, what: str, told: Any) -> dict[str, Any]:
        if what == "start":
            return self.start()
        if what == "save" and self._save is not None:
            return {"saved": self._save(self.run)}
        if what != "advance":
            raise ModelError(f"a bench does not know '{what}'")
        try:
            changes = {int(number): float(value) for number, value in told["set"]}
            ticks = int(told["ticks"])
        except (TypeError, ValueError, KeyError):
            raise ModelError("a bench is asked for ticks, with a list of changes") from None
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
        if self._is_ours(self.server.path):
            self._send(self.server.page.encode(), "text/html; charset=utf-8")

    def do_POST(self) -> None:
        if not self._is_ours(self.server.path, is_whole=False):
            return
        size = int(self.headers.get("Content-Length") or 0)
        if not 0 <= size <= MOST:
            self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
            return
        try:
            told = json.loads(self.rfile.read(size) or b"null")
            found = self.server.answer(self.path.removeprefix(self.server.path), told)
        except (DrakeDaeError, RuntimeError, ValueError, OSError) as error:
            found = {"error": " ".join(str(error).split())}
        self._send(json.dumps(found).encode(), "application/json")

    def _is_ours(self, path: str, is_whole: bool = True) -> bool:
        """Whether a request comes from the page, and not from elsewhere in the browser."""
        is_path = self.path == path if is_whole else self.path.startswith(path)
        host = self.headers.get("Host", "")
        if is_path and host in (f"{HOST}:{self.server.server_port}",):
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
        """Nothing is printed."""


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

    The page is that of `write_page`, but the loop runs here, by Drake's Simulator, so that it may
    have what no export has: Drake's own contact, contacts that open, tasks, blocks of your own.
    Only this machine reaches the page. What is changed takes effect at the next 1/120 s; "save"
    writes the record and the commands, which `replay` runs again.

    Any diagram with an output port of a vector has a bench, see `write_page`. Bodies that its
    SceneGraph poses are drawn, and links of a MultibodyPlant whose port `applied_spatial_force` is
    free are pushed.

    Args:
        loop, context, config, title, notes: As of `write_page`; of the settings all are used
            except the rate of real time.
        folder: Where "save" writes record.npz and commands.json; made if there is none.
        port: The port; 0 for any that is free.
        opens: Whether to open the page in a browser.
        tell: What prints a line.
        save: What saves a run, and says so in words; into the folder if None.

    Raises:
        ModelError: The plant of a loop is no robot; or a diagram has no output port with a vector.
        OSError: The port is in use.
    """

    def saved(run: HandRun) -> str:
        target = Path(folder)
        target.mkdir(parents=True, exist_ok=True)
        run.record().save(target / "record.npz")
        run.commands.save(target / "commands.json")
        return str(target)

    with Server(loop, context, config, title, notes, save or saved, port) as server:
        tell(f"{server.address}  (Ctrl-C ends it)")
        if opens:
            opened = False
            with suppress(webbrowser.Error):
                opened = webbrowser.open(server.address)
            if not opened:
                tell("found no browser here; open this address in one on this machine")
        with suppress(KeyboardInterrupt):
            server.serve_forever(PATIENCE)
