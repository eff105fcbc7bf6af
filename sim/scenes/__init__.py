"""Pictures with known truth, each made from a seed: for tests and benchmarks."""
