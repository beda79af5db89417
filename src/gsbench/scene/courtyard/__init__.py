"""The built-in scene, rendered by a small ray tracer."""
