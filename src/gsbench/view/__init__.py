"""The viewer of trained models: reading and drawing (``trials``), serving (``server``)."""
