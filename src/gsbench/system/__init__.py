"""The machine and its processes: locks, signals, memory, cores, compilation, installation."""
