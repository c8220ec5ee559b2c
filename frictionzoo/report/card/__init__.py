"""Cards, which publish a drive: `python -m frictionzoo.card RUN licence=...` writes, `frictionzoo.load` reads one."""
