"""The verbs of the library: train, resume, load, save, evaluate, watch, plot, check, push."""
