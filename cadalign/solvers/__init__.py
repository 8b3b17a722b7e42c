"""PnP solvers of `cadalign.fit`, without its input checks.

`aepnp` is a linear solver, `ap4p` a minimal one; `aepnp_paper` and `epnp` are baselines. All take
``points_3d`` (n, 3) and ``rays`` (n, 2), normalised image coordinates as from
`cadalign.Camera.normalize`.
"""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.solvers.baselines import aepnp_paper, epnp
    from cadalign.solvers.linear import aepnp
    from cadalign.solvers.minimal import ap4p

__all__ = ["aepnp", "aepnp_paper", "ap4p", "epnp"]

__getattr__ = lazy_names(__name__)
