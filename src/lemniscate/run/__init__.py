"""The surroundings of training: the loop's generator, checkpoints, logs, evaluation, seeds."""
