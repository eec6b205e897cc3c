"""Environments: torch in, torch out. NumPy, JAX, `info` dicts and autoreset modes stop here."""
