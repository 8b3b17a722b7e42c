"""Former name of `cadalign.estimation`."""
