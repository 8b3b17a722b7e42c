"""A page that shows a GLB file in three.js through the file's own camera."""

from __future__ import annotations

import base64
import subprocess
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser

from cadalign.arrays import FloatArray
from cadalign.geometry.camera import Camera
from support.web import copy_with_modules

_SOURCE = """
import * as THREE from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";

window.show = async ({ data, width, number, part }) => {
    const bytes = Uint8Array.from(atob(data), (c) => c.charCodeAt(0));
    const gltf = await new GLTFLoader().parseAsync(bytes.buffer, "");
    const camera = gltf.cameras[number];
    const height = Math.round(width / camera.aspect);
    const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
    renderer.setSize(width, height, false);
    renderer.setClearColor(0x000000, 1);
    const scene = new THREE.Scene();
    scene.add(gltf.scene, new THREE.HemisphereLight(0xffffff, 0x888888, 3));
    gltf.scene.traverse((each) => {
        if (!each.isMesh) return;
        const isPhoto = each.name.startsWith("photo_");
        each.visible = part === "all" || isPhoto === (part === "photo");
        if (part === "mask") {
            const side = THREE.DoubleSide;
            each.material = new THREE.MeshBasicMaterial({ color: 0xffffff, side });
        }
    });
    renderer.render(scene, camera);
    const drawn = renderer.domElement.toDataURL("image/png");
    renderer.dispose();
    return { drawn, aspect: camera.aspect, fov: camera.fov };
};
"""


@dataclass(frozen=True, eq=False)
class Shown:
    """What three.js drew, and the field of view of the file's camera."""

    image: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]
    half_field: FloatArray

    def at_pixels(self, camera: Camera) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
        """The drawn colours (h, w, 3) at the centres of a photo's pixels."""
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
        shares = camera.normalize(pixels) / self.half_field / 2 + 0.5
        height, width = self.image.shape[:2]
        place = np.floor(shares * (width, height)).astype(int)
        place = np.clip(place, 0, np.array([width, height]) - 1)
        return self.image[place[:, 1], place[:, 0]].reshape(camera.height, camera.width, 3)


class ThreeViewer:
    """three.js in a browser."""

    def __init__(self, browser: Browser, script: str) -> None:
        self._page = browser.new_page()
        self.complaints: list[str] = []
        self._page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self._page.on(
            "console", lambda word: word.type == "error" and self.complaints.append(word.text)
        )
        self._page.add_script_tag(content=script)

    def show(self, path: Path, *, part: str, width: int, number: int = 0) -> Shown:
        """Draw ``part`` of a file ("all", "mask" of the model, or "photo") from a camera in it."""
        data = base64.b64encode(path.read_bytes()).decode()
        argument = {"data": data, "width": width, "number": number, "part": part}
        found = self._page.evaluate("(argument) => window.show(argument)", argument)
        png = base64.b64decode(found["drawn"].partition(",")[2])
        down = np.tan(np.radians(found["fov"]) / 2)
        image = np.asarray(Image.open(BytesIO(png)).convert("RGB"))
        return Shown(image, np.array([found["aspect"] * down, down]))


def three_script(folder: Path) -> str:
    """Bundle three.js, its loader and the page's function; skip where npm cannot get them."""
    copy = copy_with_modules(folder)
    (copy / "viewer.js").write_text(_SOURCE)
    command = ["node_modules/.bin/esbuild", "viewer.js", "--bundle", "--format=iife"]
    built = subprocess.run(command, cwd=copy, capture_output=True, text=True)
    if built.returncode:
        pytest.fail(built.stderr)
    return built.stdout
