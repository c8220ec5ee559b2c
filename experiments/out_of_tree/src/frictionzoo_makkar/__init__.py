"""Friction model of Makkar, Dixon, Sawyer and Hu for frictionzoo."""
