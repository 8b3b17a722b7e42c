"""PyTorch is an extra: nothing loads it unasked, and its absence is named."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import cadalign
from cadalign.errors import CadalignError


def test_nothing_loads_pytorch_unasked() -> None:
    program = (
        "import sys, cadalign\nassert callable(cadalign.torch.fit)\n"
        "assert callable(cadalign.torch.posterior_loss)\nprint('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr


@pytest.mark.parametrize("name", ["fit", "align", "rotation_loss"])
def test_without_pytorch_the_message_names_the_extra(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    camera = cadalign.Camera(640, 480, 900, 900, 319.5, 239.5)
    shape = cadalign.ShapeModel.from_basis(corners, [corners * [1, 0, 0]], [0.2])
    pixels = np.zeros((1, 8, 2))
    poses = cadalign.torch.PoseBatch(np.eye(3)[None], np.zeros((1, 3)), np.ones((1, 3)))
    calls = {
        "fit": lambda: cadalign.torch.fit(corners, pixels, camera),
        "align": lambda: cadalign.torch.align(shape, pixels, camera),
        "rotation_loss": lambda: cadalign.torch.box_loss(poses, poses, np.zeros((2, 3))),
    }
    with pytest.raises(CadalignError) as refused:
        calls[name]()
    message = "cadalign.torch: PyTorch is not installed; pip install 'cadalign[torch]'"
    assert str(refused.value) == message
