"""Running another program as a trainer: its settings, input folders, process and results."""
