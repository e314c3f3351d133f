"""A page and a live bench in a notebook."""

import threading
from collections.abc import Sequence
from types import TracebackType
from typing import Self

from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.pictures.inline import InlinePage
from drake_dae.running.bench.live import PATIENCE, Server
from drake_dae.running.bench.page import page_text
from drake_dae.running.bench.run import Commands
from drake_dae.simulation.records.record import Record


@checked(ModelError)
def inline_page(
    loop: ClosedLoop | Diagram,
    context: Context | None = None,
    config: SimulatorConfig | None = None,
    title: str = "",
    notes: Sequence[str] = (),
) -> InlinePage:
    """The page of `write_page` as text, which a notebook shows in its place.

    It runs without this process, and stays in the notebook's file. Arguments and errors are those
    of `write_page`.
    """
    return InlinePage(page_text(loop, context, config, title, notes))


@checked(ModelError)
class LiveBench:
    """The bench of `live` beside this process's own work, which a notebook shows in its place.

    It runs in a thread of its own until `close` is called or the process ends. Only this machine
    reaches it: a notebook in a browser on another one shows an empty frame.

    Args:
        loop, context, config, title, notes, port: As of `live`.

    Attributes:
        address: The address of its page.

    Raises:
        ModelError: The plant of a loop is no robot; or a diagram has no output port with a vector.
        OSError: The port is in use.
    """

    def __init__(
        self,
        loop: ClosedLoop | Diagram,
        context: Context | None = None,
        config: SimulatorConfig | None = None,
        title: str = "",
        notes: Sequence[str] = (),
        port: int = 0,
    ) -> None:
        self._server = Server(loop, context, config, title, notes, self._kept, port)
        self.address = self._server.address
        serve = self._server.serve_forever
        self._thread = threading.Thread(target=serve, args=(PATIENCE,), daemon=True)
        self._thread.start()

    @property
    def record(self) -> Record:
        """The record so far."""
        with self._server.lock:
            return self._server.run.record()

    @property
    def commands(self) -> Commands:
        """What was changed so far, as `replay` takes it."""
        with self._server.lock:
            return self._server.run.commands

    def close(self) -> None:
        """Ends it; its page then says so."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"LiveBench({self.address})"

    def _repr_html_(self) -> str:
        style = "width: 100%; height: 640px; border: 0"
        return f'<iframe src="{self.address}" style="{style}"></iframe>'

    @staticmethod
    def _kept(run: object) -> str:
        return "its record and commands are those of the LiveBench"
