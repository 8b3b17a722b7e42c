"""Programs in processes of their own, forked from one that has loaded what all of them need.

They are as real as others, can be killed, and share nothing; but they start in a hundredth of the
time. What is to be seen at the start or at the end of an interpreter needs one of its own.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from typing import IO

import pytest

MAIN = "import sys; from cadalign.cli import main; sys.exit(main())"


class Program:
    """A running `python -c code arguments`, used as a `subprocess.Popen` that captures text."""

    def __init__(self, code: str, *arguments: object) -> None:
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["support.warm"])
        with pytest.MonkeyPatch.context() as patched:  # the only path that it looks for it in
            patched.setenv("PYTHONPATH", os.pathsep.join(sys.path))
            forkserver.ensure_running()
        (out, written_out), (err, written_err) = context.Pipe(False), context.Pipe(False)
        given = [code, *map(str, arguments)]
        environment, folder = dict(os.environ), os.getcwd()
        self._process = context.Process(
            target=_run, args=(given, environment, folder, written_out, written_err)
        )
        self._process.start()
        written_out.close()
        written_err.close()
        self.stdout, self.stderr = _reader(out), _reader(err)

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    def poll(self) -> int | None:
        """The exit status, None while it runs; after a signal, that of the signal, negative."""
        return self._process.exitcode

    def wait(self, timeout: float = 300) -> int:
        self._process.join(timeout)
        status = self.poll()
        if status is None:
            self.kill()
            raise AssertionError("it does not end")
        return status

    def send_signal(self, number: signal.Signals) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout: float = 300) -> tuple[str, str]:
        """Wait for its end; gives all that it wrote and that was not read yet."""
        with ThreadPoolExecutor(2) as pool:
            out, err = (pool.submit(_rest, each) for each in (self.stdout, self.stderr))
            self.wait(timeout)
            return out.result(), err.result()


def finished(code: str, *arguments: object) -> Program:
    """Run code to its end, which has to be a good one."""
    program = Program(code, *arguments)
    _, told = program.communicate()
    assert program.poll() == 0, told
    return program


def _rest(stream: IO[str]) -> str:
    """What is still to be read; nothing of a stream that was read to its end before."""
    if stream.closed:
        return ""
    with stream:
        return stream.read()


def _reader(connection: Connection) -> IO[str]:
    stream = os.fdopen(os.dup(connection.fileno()))
    connection.close()
    return stream


def _run(
    given: list[str],
    environment: dict[str, str],
    folder: str,
    out: Connection,
    err: Connection,
) -> None:
    """Run the code in this process, with its output to the other ends of two pipes."""
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    for number, connection in ((1, out), (2, err)):
        os.dup2(connection.fileno(), number)
        connection.close()
    sys.stdout = os.fdopen(1, "w", closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
    code, *arguments = given
    sys.argv = ["-c", *arguments]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    exec(compile(code, "<string>", "exec"), {"__name__": "__main__"})
