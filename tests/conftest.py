"""What tests share."""

import pytest


@pytest.fixture
def start_bench(sim_bench):
    """Start simulated benches; each ends with the test."""
    return sim_bench
