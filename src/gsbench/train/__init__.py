"""The trainer and its parts: options, loss, training views, checkpoints, logs."""
