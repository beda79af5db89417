"""The machine and its processes: locks, signals, memory, cores, installation."""
