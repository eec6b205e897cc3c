"""What surrounds training: the loop's generator, checkpoints, logs, evaluation, seeds."""
