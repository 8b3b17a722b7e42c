"""PyTorch is optional: importing cadalign does not load it, and its absence has a message."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import cadalign
from cadalign.errors import CadalignError


def test_import_does_not_load_pytorch() -> None:
    program = (
        "import sys, cadalign\nassert callable(cadalign.torch.fit)\nprint('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr


def test_without_pytorch_the_message_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "cadalign.torch.layer", raising=False)
    monkeypatch.setitem(sys.modules, "torch", None)
    camera = cadalign.Camera(640, 480, 900, 900, 319.5, 239.5)
    with pytest.raises(CadalignError) as refused:
        cadalign.torch.fit(np.zeros((8, 3)), np.zeros((1, 8, 2)), camera)
    message = "cadalign.torch: PyTorch is not installed; pip install 'cadalign[torch]'"
    assert str(refused.value) == message
