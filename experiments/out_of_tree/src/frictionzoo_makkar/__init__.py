"""The friction law of Makkar, Dixon, Sawyer and Hu for frictionzoo."""
