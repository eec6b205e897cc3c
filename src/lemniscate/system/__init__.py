"""What touches the machine: processes, shared memory, files, the terminal, objects by name."""
