"""Ray: one run as a job of several workers, or the runs of a set as tasks, on the machines of a cluster."""
