"""The page's warp of a model is that of `cadalign.shapes.warp`."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import cadalign.web
from cadalign import Mesh
from cadalign.shapes.warp import warp_mesh

SCRIPT = """
const { warpOf } = await import(process.argv[1]);
let text = "";
for await (const part of process.stdin) text += part;
const { warp, bounds, points } = JSON.parse(text);
process.stdout.write(JSON.stringify(warpOf(warp, bounds)(points)));
"""


@pytest.mark.slow
@pytest.mark.parametrize("count", [0, 1, 2, 5, 20])
def test_page_warps_as_python_does(count: int) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node here; on Debian: apt-get install nodejs")
    rng = np.random.default_rng(count)
    vertices = rng.uniform(-1, 1, (50, 3)) * [1.0, 2.0, 0.5]
    mesh = Mesh(vertices, np.arange(48).reshape(-1, 3))
    source = rng.uniform(-1, 1, (count, 3)) * [1.0, 2.0, 0.5]
    target = source + rng.normal(0, 0.1, (count, 3))
    if count > 4:  # coincident keypoints move by the mean
        source[1] = source[0]
    data = {
        "warp": {"from": source.tolist(), "to": target.tolist()},
        "bounds": mesh.bounds.tolist(),
        "points": vertices.tolist(),
    }
    module = Path(cadalign.web.__file__).with_name("report") / "warp.js"
    done = subprocess.run(
        [node, "--input-type=module", "-e", SCRIPT, module.as_uri()],
        input=json.dumps(data),
        capture_output=True,
        text=True,
        check=True,
    )
    expected = vertices
    if count:
        expected = warp_mesh(mesh, source, target, bounds=mesh.bounds).vertices
    np.testing.assert_allclose(json.loads(done.stdout), expected, atol=1e-9)
