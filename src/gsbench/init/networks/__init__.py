"""Features and matches by networks."""
