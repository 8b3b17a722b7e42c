"""Former name of parts of `cadalign.estimation`."""
