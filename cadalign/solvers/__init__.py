"""The solvers behind `cadalign.fit`, without its checks: points and rays in, alignments out.

`aepnp` is linear, `ap4p` minimal; `aepnp_paper` and `epnp` are baselines. All take ``points_3d``
(n, 3) and ``rays`` (n, 2), the normalised image coordinates that `cadalign.Camera.normalize` gives.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cadalign.solvers.linear import aepnp
    from cadalign.solvers.minimal import ap4p
    from cadalign.solvers.opencv import epnp
    from cadalign.solvers.paper import aepnp_paper

__all__ = ["aepnp", "aepnp_paper", "ap4p", "epnp"]

_LAZY = {"aepnp": "linear", "aepnp_paper": "paper", "ap4p": "minimal", "epnp": "opencv"}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(f"cadalign.solvers.{_LAZY[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
