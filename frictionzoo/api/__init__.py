"""Functions and objects of `import frictionzoo`, for scripts and notebooks."""
