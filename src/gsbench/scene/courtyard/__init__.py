"""The built-in scene: a courtyard, rendered by a small ray tracer."""
