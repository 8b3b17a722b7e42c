"""`cadalign annotate`: align a model to photos by clicking, in the browser."""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import dataclass

import tyro

from cadalign.annotate.options import SessionOptions
from cadalign.cli.output import make_folder, new_console
from cadalign.io.files import writing


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
        from cadalign.annotate.opening import open_session
        from cadalign.annotate.server import listen, make_app, serve

        console = new_console()
        listener = listen(self.port)
        with listener:
            if self.out is not None:
                make_folder(self.out)
            if self.observation is not None:
                with writing(self.observation):
                    self.observation.parent.mkdir(parents=True, exist_ok=True)
            with console.status("reading photos and model"):
                session = open_session(self)
            access = Access(listener.getsockname()[1])
            threading.Thread(target=session.warm_up, daemon=True).start()
            new_console(stderr=False).print(access.url, markup=False, soft_wrap=True)
            console.print(
                "Open this address in a browser; end with Ctrl+C. It works on this machine only, "
                "and for this session.",
                markup=False,
            )
            if not self.no_open:
                webbrowser.open(access.url)
            with suppress(KeyboardInterrupt):
                serve(make_app(session, access), listener)
        folder = session.keypoints_path.parent
        console.print(f"Saved in {folder.absolute()}", markup=False)
        return 0
