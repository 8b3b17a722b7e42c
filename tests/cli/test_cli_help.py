"""Help of every command: each option is described once, and its default stated once."""

from __future__ import annotations

import contextlib
import io
import logging
import re
from functools import cache

import pytest

from cadalign.cli import drop_repeats, main

PATHS = (
    *("demo", "fit", "observe", "annotate", "retrieve", "report", "export", "render", "doctor"),
    *("library build", "library show", "shape learn", "shape list", "shape show"),
    *("evaluate keypointnet", "evaluate unseen", "evaluate photos"),
    *("evaluate correspondences", "evaluate retrieval", "simulate"),
)


@cache
def printed(path: str) -> str:
    """The --help of a command, without colours."""
    out = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.setenv("COLUMNS", "96")
        with pytest.raises(SystemExit):
            main([*path.split(), "--help"])
    return re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue())


def subcommands(path: str) -> set[str]:
    """Names of the subcommands in the usage line of a command."""
    usage, _, rest = printed(path).partition("\n\n")
    found = re.search(r"\{([a-z,-]+)\}", usage)
    return set(found.group(1).split(",")) if found and "subcommands" in rest else set()


def options(path: str) -> dict[str, str]:
    """The options of a command, each with its help on one line."""
    found: dict[str, str] = {}
    name = ""
    for line in printed(path).splitlines():
        text = line.replace("│", " ").rstrip()
        start = re.match(r"  (--?[a-z][\w-]*|[A-Z][A-Z_]*)\b", text)
        if start:
            name = start.group(1)
            found[name] = ""
        elif not text.startswith("   "):
            name = ""
        if name:
            found[name] += " " + text.strip()
    return {name: re.sub(r"\s+", " ", text) for name, text in found.items()}


@pytest.mark.long
def test_paths_are_all_commands() -> None:
    below = {path for name in subcommands("") for path in _leaves(name)}
    assert below == set(PATHS)


def _leaves(path: str) -> list[str]:
    names = sorted(subcommands(path))
    return [leaf for name in names for leaf in _leaves(f"{path} {name}")] or [path]


@pytest.mark.parametrize("path", PATHS)
def test_every_option_is_described(path: str) -> None:
    assert options(path)
    for name, text in options(path).items():
        rest = re.sub(r"\((default|required|repeatable|optional)[^()]*\)", "", text)
        words = re.findall(r"(?<![-{|,])\b[a-z]{2,}\b", rest)
        assert len(words) >= 2, (name, text)


@pytest.mark.parametrize("path", PATHS)
def test_no_default_is_told_twice(path: str) -> None:
    for name, text in options(path).items():
        stated = re.findall(r"\(default: ([^()]*)\)", text)
        assert not {"", "None", "False"} & {each.strip() for each in stated}, (name, text)
        told = stated and stated[0] != "True"
        assert not (told and re.search(r"\bby default\b|\bdefaults? (is|to)\b", text)), (name, text)
        assert len(stated) <= 1, (name, text)


def test_lines_of_a_description_are_joined() -> None:
    start = printed("fit").index("--similar")
    lines = [line.strip("│ ") for line in printed("fit")[start:].splitlines()[1:4]]
    assert all(len(line) > 45 for line in lines[:2]), lines


def test_a_repeated_warning_is_printed_once() -> None:
    handler = logging.StreamHandler(out := io.StringIO())
    handler.addFilter(drop_repeats())
    for name in ("a.obj", "a.obj", "b.obj"):
        handler.handle(logging.LogRecord("", logging.WARNING, "", 0, "%s: grey", (name,), None))
    assert out.getvalue() == "a.obj: grey\nb.obj: grey\n"


@pytest.mark.parametrize("path", PATHS)
def test_no_description_stands_twice(path: str) -> None:
    every: dict[str, str] = {}
    for name, text in options(path).items():
        described = re.sub(r"\([^()]*\)", "", text)
        for sentence in re.split(r"(?<=[.;]) ", described):
            words = " ".join(re.findall(r"[a-z]{2,}", sentence.replace(name, "")))
            if len(words.split()) >= 4:
                assert words not in every, (name, every.get(words), sentence)
                every[words] = name
    text = " ".join(printed(path).replace("│", " ").split())
    first_sentence = " ".join(printed(path).split("\n\n")[1].split()).split(". ")[0]
    assert text.count(first_sentence) == 1
