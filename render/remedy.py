"""The exact command that would enable a renderer that does not work."""

from __future__ import annotations

import ctypes
import re
import sys
from importlib.util import find_spec

from cadalign.render.probe import Probe

# Shared libraries and the Debian packages that hold them.
_DEBIAN_PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libusb-1.0.so.0": "libusb-1.0-0",
}
_NEEDED = {
    "pyrender": ("libEGL.so.1", "libGL.so.1"),
    "open3d": ("libX11.so.6", "libGL.so.1", "libgomp.so.1"),
    "raycast": (),
}
_MODULES = {"pyrender": ("pyrender", "pyrender2"), "open3d": ("open3d", "'cadalign[open3d]'")}


def remedy(probe: Probe) -> str:
    """The command that would enable a renderer; empty where it works or none is known.

    Examples
    --------
    >>> remedy(Probe("raycast", True, "processor", ""))
    ''
    """
    if probe.works:
        return ""
    if probe.name in _MODULES:
        module, package = _MODULES[probe.name]
        if find_spec(module) is None:
            return f"{sys.executable} -m pip install {package}"
    named = re.findall(r"lib[\w.+-]+\.so[.\d]*", probe.detail)
    absent = [*missing_libraries(probe.name), *(name for name in named if not _loads(name))]
    packages = dict.fromkeys(
        _DEBIAN_PACKAGES[library] for library in absent if library in _DEBIAN_PACKAGES
    )
    if packages:
        return f"sudo apt-get install {' '.join(packages)}"
    if probe.name == "pyrender":
        # The libraries are there; what is missing is a driver that needs no display.
        return "sudo apt-get install libegl-mesa0 libgl1-mesa-dri"
    if probe.name == "raycast":
        return f"{sys.executable} -m pip install --force-reinstall embreex trimesh"
    return ""


def missing_libraries(name: str) -> list[str]:
    """The shared libraries that a renderer needs and that cannot be loaded (Linux only)."""
    if not sys.platform.startswith("linux"):
        return []
    return [library for library in _NEEDED[name] if not _loads(library)]


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
