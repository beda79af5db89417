"""The trainer and its parts, a library: options, loss, learning rates, checkpoints."""
