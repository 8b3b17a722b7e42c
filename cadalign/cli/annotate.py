"""`cadalign annotate`: align a model to photos by clicking, in the browser."""

from __future__ import annotations

import signal
import tempfile
import threading
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from rich.console import Console

from cadalign.annotate.options import SessionOptions
from cadalign.cli.output import make_folder, new_console
from cadalign.io.files import writing

if TYPE_CHECKING:
    from cadalign.annotate.session import Session


@dataclass(frozen=True)
class Annotate(SessionOptions):
    """Mark keypoints on photos and a model in the browser, and see the alignment as you go.

    Serves a page on this machine only. Every change is saved at once: an observation beside each
    photo (photo.json), its alignment (photo_fit/fit.json), and the model's keypoints
    (model.keypoints.json).
    """

    port: int = 0
    """Port to listen on; 0 for a free one."""
    no_open: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print the address instead of opening a browser."""

    def run(self) -> int:
        """Serve until interrupted; returns the exit code."""
        import webbrowser

        from cadalign.annotate.guard import Access
        from cadalign.annotate.locks import WriterLocks
        from cadalign.annotate.opening import find_session_files, open_session
        from cadalign.annotate.server import listen, make_app, serve

        console = new_console()
        listener = listen(self.port)
        with ExitStack() as opened:
            opened.enter_context(listener)
            if self.out is not None:
                make_folder(self.out)
            if self.observation is not None:
                with writing(self.observation):
                    self.observation.parent.mkdir(parents=True, exist_ok=True)
            access = Access(listener.getsockname()[1])
            files = find_session_files(self)
            locks = opened.enter_context(
                WriterLocks(files.written, whole_folder=self.image.is_dir(), address=access.address)
            )
            with console.status("reading photos and model"):
                session = open_session(self, files, before_saving=locks.confirm)
            threading.Thread(target=session.warm_up, daemon=True).start()
            new_console(stderr=False).print(access.url, markup=False, soft_wrap=True)
            console.print(
                "Open this address in a browser; end with Ctrl+C. It works on this machine only, "
                "and for this session.",
                markup=False,
            )
            if not self.no_open:
                webbrowser.open(access.url)
            # Ends as Ctrl+C does, with everything saved and unlocked.
            signal.signal(signal.SIGTERM, signal.default_int_handler)
            with suppress(KeyboardInterrupt):
                serve(make_app(session, access), listener)
            return _save_and_say_where(session, console)


def _save_and_say_where(session: Session, console: Console) -> int:
    """Save what could not be saved before, elsewhere if need be; returns the exit code."""
    folder = session.keypoints_path.parent.absolute()
    session.save_unsaved()
    if not session.unsaved:
        console.print(f"Saved in {folder}", markup=False)
        return 0
    for trouble in sorted({state.save_error for state in session.unsaved}):
        console.print(f"Not saved: {trouble}", markup=False)
    elsewhere = Path(tempfile.mkdtemp(prefix="cadalign-annotate-"))
    session.save_unsaved(elsewhere)
    if not session.unsaved:
        console.print(f"Saved in {elsewhere} instead", markup=False)
    return 1
