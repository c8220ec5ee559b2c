"""Data sources, the file formats they read, and the cleaning that turns recordings into logs."""
