"""Renderers over many frames, in pools of processes, and in forked processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
import trimesh
from support.renderers import renderer_or_skip, skip_unless_works

from cadalign import Camera, Mesh
from cadalign.errors import RenderError
from cadalign.render import Scene, look_at

pytestmark = pytest.mark.slow

CAMERA = Camera.from_fov(160, 120, fov_x=50)


_BALL = """
import trimesh
from cadalign import Mesh

def ball(subdivisions):
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh(shape.vertices, shape.faces)
"""

_POOL_SCRIPT = (
    _BALL
    + """
import json, multiprocessing
from concurrent.futures import ProcessPoolExecutor
from cadalign import Camera
from cadalign.render import Scene, look_at
from cadalign.render.probe import load_renderer

def draw(azimuth):
    camera = Camera.from_fov(160, 120, fov_x=50)
    view = look_at(azimuth=azimuth, elevation=20, distance=5, scale=(1, 0.5, 2))
    frame = load_renderer("pyrender", None).render(Scene(ball(3)), camera, view)
    return int(frame.color.astype(int).sum())

if __name__ == "__main__":
    alone = [draw(azimuth) for azimuth in (0, 40, 80, 120)]
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        print(json.dumps([alone, list(pool.map(draw, (0, 40, 80, 120)))]))
"""
)


@pytest.mark.long
def test_a_spawned_pool_draws_with_pyrender_after_the_parent_has(tmp_path):
    skip_unless_works("pyrender")
    script = tmp_path / "pool.py"
    script.write_text(_POOL_SCRIPT)
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    alone, pooled = json.loads(done.stdout.splitlines()[-1])
    assert alone == pooled
    assert len(set(alone)) == 4


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
@pytest.mark.filterwarnings("ignore:.*fork.*")
def test_a_forked_process_raises_and_does_not_hang():
    renderer = renderer_or_skip("pyrender")
    shape = trimesh.creation.icosphere(subdivisions=2)
    scene = Scene(Mesh(shape.vertices, shape.faces))
    view = look_at(azimuth=0, elevation=20, distance=5)
    renderer.render(scene, CAMERA, view)
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        try:
            renderer.render(scene, CAMERA, view)
            answer = b"drawn"
        except RenderError as error:
            answer = str(error).encode()
        os.write(writing, answer)
        os._exit(0)
    os.waitpid(child, 0)
    assert b"forked" in os.read(reading, 1000)


_MEMORY_SCRIPT = (
    _BALL
    + """
from cadalign import Camera
from cadalign.render import Scene, look_at
from cadalign.render.probe import load_renderer

def resident():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmRSS"))

renderer = load_renderer("pyrender", None)
camera = Camera.from_fov(160, 120, fov_x=50)
scenes = [Scene(ball(3)), Scene(ball(4))]
for number in range(80):
    if number == 25:
        before = resident()
    view = look_at(azimuth=3.6 * number, elevation=20, distance=6)
    frame = renderer.render(scenes[number // 10 % 2], camera, view)
    assert frame.mask.any() and (frame.color[:, :, 3] == 255).any()
print(resident() - before)
"""
)


@pytest.mark.long
@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="needs /proc")
def test_memory_stays_flat_over_many_frames():
    skip_unless_works("pyrender")
    done = subprocess.run(
        [sys.executable, "-c", _MEMORY_SCRIPT],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    # 50 kB per frame: less than the colours and depths of a frame, which a leak would keep.
    assert int(done.stdout.splitlines()[-1]) < 2_750, "kB more than after 25 frames"
    assert "GLError" not in done.stderr
