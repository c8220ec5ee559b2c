"""`python -m frictionzoo.run`, see `frictionzoo.cli.run`."""

# Processes started by launchers cannot import from __main__.
if __name__ == "__main__":
    from frictionzoo.cli.commands import main

    main("run")
