"""Structure from motion by COLMAP: database, matching, reconstruction, alignment."""
