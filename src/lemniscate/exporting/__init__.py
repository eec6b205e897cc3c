"""Policies outside of Python: ONNX, C99 for microcontrollers, and how far these are from the policy itself."""
