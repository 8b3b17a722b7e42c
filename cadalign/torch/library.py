"""PyTorch, imported when it is first used: nothing else of cadalign needs it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cadalign.errors import CadalignError

if TYPE_CHECKING:
    import torch
else:

    class _LazyLibrary:
        """PyTorch's names; CadalignError, which names the extra, where it is not installed."""

        def __getattr__(self, name: str) -> Any:
            try:
                import torch
            except ImportError:
                raise CadalignError(
                    "PyTorch is not installed",
                    where="cadalign.torch",
                    fix="pip install 'cadalign[torch]'",
                ) from None
            return getattr(torch, name)

    torch = _LazyLibrary()

__all__ = ["torch"]
