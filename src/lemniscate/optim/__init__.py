"""Gradient steps: one vector of parameters, Adam, and the compilation of an algorithm's `learn`."""
