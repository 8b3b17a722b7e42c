"""An annotator that is killed while it is used, and what it finds when it is started again."""

from __future__ import annotations

import http.client
import json
import re
import shutil
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cadalign.annotate.actions import perform
from cadalign.annotate.page_state import page_state
from cadalign.annotate.session import Session
from cadalign.errors import CadalignError
from support.annotating import Case
from support.forked import MAIN, Program

_LATEST = 2.5  # after the first action that an annotator is killed [s]


@dataclass(frozen=True)
class Killed:
    """One annotator: how many actions it answered, and what a new one had lost of them."""

    answered: int
    was_busy: bool
    found: dict[str, Any]
    expected: tuple[dict[str, Any], ...]
    action: dict[str, Any] | None = None  # that was under way

    @property
    def lost(self) -> bool:
        """True if the files have neither what was answered last nor what was under way."""
        return self.found not in self.expected

    @property
    def differences(self) -> list[str]:
        """What was found in place of what was expected."""
        told = []
        for expected in self.expected:
            for name, value in self.found.items():
                if value != expected[name]:
                    told.append(f"{name}: {_told(value)}, not {_told(expected[name])}")
        return told


def content(state: dict[str, Any]) -> dict[str, Any]:
    """What a person has put in, of a state of the page."""
    evidence = state["evidence"]
    pairs = sorted(
        json.dumps([pair["uv"], pair["keypoint"], pair["name"]]) for pair in state["pairs"]
    )
    return {
        "pairs": pairs,
        "mask": evidence["mask"] is not None,
        "lengths": evidence["lengths"],
        "verticals": len(evidence["verticals"]),
        "mark": state["image"]["state"],
    }


def _told(value: Any) -> str:
    return f"{len(value)} of them" if isinstance(value, list) else repr(value)


def kill_at_random(case: Case, *, rounds: int, seed: int) -> Iterator[Killed]:
    """Use an annotator, kill it at a random moment, and start the next one on its files."""
    rng = np.random.default_rng(seed)
    annotator = _Annotator(case)
    try:
        for _ in range(rounds):
            shadow = _Shadow(case)
            answered, last, action = 0, shadow.content, None
            threading.Timer(rng.uniform(0.05, _LATEST), annotator.kill).start()
            with suppress(OSError, http.client.HTTPException, json.JSONDecodeError):
                while True:
                    action = _draw(rng, shadow.state)
                    last = content(annotator.act(action))
                    shadow.act(action)
                    answered, action = answered + 1, None
            annotator.process.wait()
            expected = [last]
            if action is not None:
                shadow.act(action)
                expected.append(shadow.content)
            annotator = _Annotator(case)
            found = content(annotator.state())
            yield Killed(answered, action is not None, found, tuple(expected), action)
    finally:
        annotator.kill()
        annotator.process.wait()


class _Annotator:
    """A process of `cadalign annotate`."""

    def __init__(self, case: Case) -> None:
        arguments = [case.photo, case.model, "--camera", case.camera, "--keypoints", case.keypoints]
        self.process = Program(MAIN, "annotate", "--no-open", *arguments)
        line = self.process.stdout.readline()
        found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\?token=(.+)\n", line)
        assert found, line
        self._port, self._token = int(found[1]), found[2]

    def act(self, action: dict[str, Any]) -> dict[str, Any]:
        state = self._ask("POST", "/act/0", json.dumps(action))
        return self.state() if "error" in state else state

    def state(self) -> dict[str, Any]:
        return self._ask("GET", "/state/0", None)

    def kill(self) -> None:
        self.process.kill()

    def _ask(self, method: str, path: str, body: str | None) -> dict[str, Any]:
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=120)
        headers = {"X-Cadalign-Token": self._token, "Content-Type": "application/json"}
        connection.request(method, path, body=body, headers=headers)
        answer: dict[str, Any] = json.loads(connection.getresponse().read())
        connection.close()
        return answer


class _Shadow:
    """A session on a copy of the files, which nobody kills: it tells what an action does."""

    def __init__(self, case: Case) -> None:
        folder = case.folder.with_name(f"{case.folder.name}-shadow")
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(case.folder, folder)
        copy = replace(
            case, folder=folder, photo=folder / case.photo.name, camera=folder / case.camera.name,
            keypoints=folder / case.keypoints.name,
        )  # fmt: skip
        self._session: Session = copy.open(prepared=False)

    @property
    def state(self) -> dict[str, Any]:
        return page_state(self._session, 0)

    @property
    def content(self) -> dict[str, Any]:
        return content(self.state)

    def act(self, action: dict[str, Any]) -> None:
        with suppress(CadalignError):
            perform(self._session, 0, action)


def _draw(rng: np.random.Generator, state: dict[str, Any]) -> dict[str, Any]:
    """A random action that makes sense."""
    pairs = [pair["pair"] for pair in state["pairs"]]
    free = [each["keypoint"] for each in state["keypoints"] if not each["used"]]
    uv = [float(value) for value in rng.uniform((20, 20), (600, 440)).round(2)]
    other = [float(value) for value in rng.uniform((20, 20), (600, 440)).round(2)]
    start = int(rng.integers(1, 9999))
    actions: list[dict[str, Any]] = [
        {"do": "place_uv", "uv": uv},
        {"do": "mask_load", "runs": [start, 5000, 640 * 480 - 5000 - start]},
        {"do": "mask_clear"},
        {"do": "lengths", "height": float(rng.integers(1, 9))},
        {"do": "vertical", "ends": [uv, other]},
        {"do": "gravity_clear"},
        {"do": "mark", "mark": "done"},
        {"do": "mark"},
        {"do": "undo"},
        {"do": "redo"},
        {"do": "pick", "origin": [0.02, 3, 0.03], "direction": [0, -1, float(rng.normal(0, 0.03))]},
    ]
    weights = [6, 1, 0.5, 1, 1, 0.5, 0.5, 0.5, 2, 1, 2]
    if free:
        actions.append({"do": "place_keypoint", "keypoint": int(rng.choice(free))})
        weights.append(7)
    if pairs:
        pair = int(rng.choice(pairs))
        actions += [
            {"do": "delete", "pair": pair},
            {"do": "move", "pair": pair, "uv": uv},
            {"do": "release", "pair": pair},
            {"do": "rename", "pair": pair, "name": f"name {rng.integers(10**6)}"},
        ]
        weights += [1, 3, 1, 1]
    chance = np.array(weights) / np.sum(weights)
    return actions[int(rng.choice(len(actions), p=chance))]
