"""Every sampler on every problem, in one table."""
