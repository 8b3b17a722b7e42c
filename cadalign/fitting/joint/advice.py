"""Former name of `cadalign.estimation.uncertainty.advice`."""

from cadalign.estimation.uncertainty.advice import Advice, rank_evidence

__all__ = ["Advice", "rank_evidence"]
