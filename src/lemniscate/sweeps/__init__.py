"""Several runs: sweeps over algorithms and seeds, and the search for settings."""
