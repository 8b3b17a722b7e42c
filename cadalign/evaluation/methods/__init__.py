"""Methods that benchmarks run on instances: built-in ones, and those that users register."""
