"""A page and a live bench in a notebook."""

import threading
from collections.abc import Sequence
from typing import Self

from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.pictures.inline import InlinePage
from drake_dae.running.bench.live import POLL_INTERVAL, Server
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
    """Returns the page of `write_page` as an object that a notebook displays in its output cell.

    The page runs without this process, and is stored in the notebook's file. For arguments and
    errors see `write_page`.
    """
    return InlinePage(page_text(loop, context, config, title, notes))


@checked(ModelError)
class LiveBench:
    """Runs the bench of `live` in the background; a notebook displays its page in an output cell.

    The bench runs in a separate thread until `close` is called or the process ends. Only browsers
    on this machine reach it: a notebook in a browser on another machine shows an empty frame.

    Args:
        loop, context, config, title, notes, port: See `live`.

    Attributes:
        address: The address of the page.

    Raises:
        ModelError: The plant of a loop is not a robot, or a diagram has no vector output port.
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
        self._server = Server(loop, context, config, title, notes, self._saved, port)
        self.address = self._server.address
        serve = self._server.serve_forever
        self._thread = threading.Thread(target=serve, args=(POLL_INTERVAL,), daemon=True)
        self._thread.start()

    @property
    def record(self) -> Record:
        """The record from the start until now."""
        with self._server.lock:
            return self._server.run.record()

    @property
    def commands(self) -> Commands:
        """The changes from the start until now, for `replay`."""
        with self._server.lock:
            return self._server.run.commands

    def close(self) -> None:
        """Ends the run and its server; the page then reports this."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"LiveBench({self.address})"

    def _repr_html_(self) -> str:
        style = "width: 100%; height: 640px; border: 0"
        return f'<iframe src="{self.address}" style="{style}"></iframe>'

    @staticmethod
    def _saved(run: object) -> str:
        return "its record and commands are those of the LiveBench"
