"""`cadalign annotate`: align a model to photos by clicking in the browser."""

from __future__ import annotations

import signal
import threading
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from cadalign.annotate.files import SessionOptions, lock_folder
from cadalign.cli.common import UsageError, answer, say, show_status
from cadalign.io.files import create_folder, guard_writing
from cadalign.io.kinds import MESH, PHOTO, kind_of_file

if TYPE_CHECKING:
    from cadalign.annotate.session import Session


@dataclass(frozen=True, kw_only=True)
class Annotate(SessionOptions):
    """Mark keypoints on photos and a model in the browser, with a live alignment.

    Serves a page that only this machine can open. Saves every change at once: an observation beside
    each photo (photo.json), for `cadalign fit`, and the model's keypoints (model.keypoints.json).
    Without a model: `cadalign annotate photo.jpg --shape chair`.
    """

    image: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTO")]
    """A photo, or a folder of photos."""
    model: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[MODEL]")] = None
    """The model: an OBJ, PLY, GLB, glTF, STL or OFF file. With --shape it may be left out: the
    keypoints of the shape are marked in the photo alone, one after the other."""
    port: int = 0
    """Port of the page; 0 selects a free port."""
    no_open: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print the address instead of opening a browser."""

    def run(self) -> int:
        """Serve until interrupted; returns the exit code."""
        import webbrowser

        from cadalign.annotate.server import Access, listen, make_app, make_server
        from cadalign.annotate.session import find_session_files, open_session

        given = [path for path in (self.image, self.model) if path is not None]
        if [kind_of_file(path) for path in given] == [MESH, PHOTO]:
            what = f"{self.image} is a mesh and {self.model} is a photo: swap them"
            raise UsageError(what, where="PHOTO MODEL", fix="cadalign annotate PHOTO MODEL")
        if self.model is None and self.shape is None:
            fix = "give the CAD model, or a category, such as --shape chair"
            raise UsageError("neither a model nor a shape is given", where="MODEL", fix=fix)
        listener = listen(self.port)
        with ExitStack() as opened:
            opened.enter_context(listener)
            if self.out is not None:
                create_folder(self.out)
            if self.observation is not None:
                with guard_writing(self.observation):
                    self.observation.parent.mkdir(parents=True, exist_ok=True)
            access = Access(listener.getsockname()[1])
            files = find_session_files(self)
            opened.enter_context(lock_folder(files[0][1].parent))
            with show_status("reading photos and model"):
                session = open_session(self, files)
            warming = threading.Thread(target=session.warm_up, daemon=True)
            warming.start()
            # A C++ extension that still runs when the interpreter ends aborts the process.
            opened.callback(warming.join)
            opened.callback(session.ended.set)
            with suppress(KeyboardInterrupt):
                # SIGTERM ends the command as Ctrl+C does: marks are saved, files unlocked.
                signal.signal(signal.SIGTERM, signal.default_int_handler)
                answer(access.url)
                say("Open this address in a browser on this machine. End with Ctrl+C.")
                if not self.no_open:
                    webbrowser.open(access.url)
                make_server(make_app(session, access)).run(sockets=[listener])
            return _save(session)


def _save(session: Session) -> int:
    """Save all annotations that could not be saved before; returns the exit code."""
    session.save_unsaved()
    for trouble in sorted({each.save_error for each in session.unsaved}):
        say(f"Not saved: {trouble}")
    if not session.unsaved:
        say(f"Saved in {session.photos[0].file.path.parent.absolute()}")
    return bool(session.unsaved)
