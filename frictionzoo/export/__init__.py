"""Export of an identified drive to other programs: one module for each format."""
