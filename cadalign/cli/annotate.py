"""`cadalign annotate`: align a model to photos by clicking, in the browser."""

from __future__ import annotations

import signal
import threading
from contextlib import ExitStack, suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from cadalign.annotate.options import FileOptions, SessionOptions
from cadalign.cli.common import UsageError, answer, make_folder, say, waiting
from cadalign.cli.options import flag_of
from cadalign.io.files import writing
from cadalign.io.kinds import MESH, PHOTO, kind_of_file

if TYPE_CHECKING:
    from cadalign.annotate.session import Session

_FILES = tyro.conf.arg(metavar="PHOTO MODEL")


@dataclass(frozen=True, kw_only=True)
class Annotate(FileOptions):
    """Mark keypoints on photos and a model in the browser, and see the alignment as you go.

    Serves a page on this machine only. Every change is saved at once: an observation beside each
    photo (photo.json), which `cadalign fit` aligns, and the model's keypoints
    (model.keypoints.json).
    """

    files: Annotated[tuple[Path, ...], tyro.conf.Positional, _FILES] = ()
    """A photo or a folder of photos, and the model, an OBJ, PLY, GLB, glTF, STL or OFF file."""
    image: Path | None = None
    """The photo or folder, in place of PHOTO."""
    model: Path | None = None
    """The model, in place of MODEL."""
    port: int = 0
    """Port to listen on; 0 for a free one."""
    no_open: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print the address instead of opening a browser."""

    @property
    def session(self) -> SessionOptions:
        """Options of the session.

        Raises
        ------
        UsageError
            If photo or model are missing, or given twice.
        """
        files = list(self.files)
        found: dict[str, Path] = {}
        for name, given in (("image", self.image), ("model", self.model)):
            path = given if given is not None else (files.pop(0) if files else None)
            if path is None:
                what = "no photo is given" if name == "image" else "no model is given"
                raise UsageError(what, where=flag_of(name), fix="cadalign annotate PHOTO MODEL")
            found[name] = path
        if files:
            what = f"{files[0]} is one file too many"
            raise UsageError(what, where="PHOTO MODEL", fix="give a folder for several photos")
        if [kind_of_file(found[name]) for name in ("image", "model")] == [MESH, PHOTO]:
            what = f"{found['image']} is a mesh and {found['model']} a photo: they are exchanged"
            raise UsageError(what, where="PHOTO MODEL", fix="cadalign annotate PHOTO MODEL")
        rest: dict[str, Any] = {
            field.name: getattr(self, field.name) for field in fields(FileOptions)
        }
        return SessionOptions(**(found | rest))

    def run(self) -> int:
        """Serve until interrupted; returns the exit code."""
        import webbrowser

        from cadalign.annotate.files import only_annotator
        from cadalign.annotate.server import Access, listen, make_app, make_server
        from cadalign.annotate.session import find_session_files, open_session

        options = self.session
        listener = listen(self.port)
        with ExitStack() as opened:
            opened.enter_context(listener)
            if self.out is not None:
                make_folder(self.out)
            if self.observation is not None:
                with writing(self.observation):
                    self.observation.parent.mkdir(parents=True, exist_ok=True)
            access = Access(listener.getsockname()[1])
            files = find_session_files(options)
            opened.enter_context(only_annotator(files[0][1].parent))
            with waiting("reading photos and model"):
                session = open_session(options, files)
            warming = threading.Thread(target=session.warm_up, daemon=True)
            warming.start()
            # An extension in C++ that works on while the interpreter ends aborts the process.
            opened.callback(warming.join)
            opened.callback(session.ended.set)
            with suppress(KeyboardInterrupt):
                # Ends as Ctrl+C does, with everything saved and unlocked.
                signal.signal(signal.SIGTERM, signal.default_int_handler)
                answer(access.url)
                say("Open this address in a browser of this machine; end with Ctrl+C.")
                if not self.no_open:
                    webbrowser.open(access.url)
                make_server(make_app(session, access)).run(sockets=[listener])
            return _save_and_say_where(session)


def _save_and_say_where(session: Session) -> int:
    """Save what could not be saved before; returns the exit code."""
    session.save_unsaved()
    for trouble in sorted({each.save_error for each in session.unsaved}):
        say(f"Not saved: {trouble}")
    if not session.unsaved:
        say(f"Saved in {session.model.keypoints_path.parent.absolute()}")
    return bool(session.unsaved)
