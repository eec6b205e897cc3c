"""Networks, policies and the observation normalizer."""
