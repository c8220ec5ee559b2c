"""A drive for others: `python -m frictionzoo.card RUN licence=...` writes it, `frictionzoo.load` reads it."""
