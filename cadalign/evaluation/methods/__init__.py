"""Methods that benchmarks run on instances."""
