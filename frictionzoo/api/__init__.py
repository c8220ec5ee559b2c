"""What `import frictionzoo` gives: functions for scripts and notebooks, and the objects that they return."""
