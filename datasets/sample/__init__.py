"""A data set that cadalign makes itself: parametric chairs, bottles, cars and vessels."""
