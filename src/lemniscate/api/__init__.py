"""The verbs of the library: train, resume, load, evaluate, watch, plot, check, push."""
