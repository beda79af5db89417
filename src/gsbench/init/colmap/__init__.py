"""Structure from motion with COLMAP: database, matching, reconstruction and alignment."""
