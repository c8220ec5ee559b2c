"""`python -m frictionzoo.run`, see `frictionzoo.cli.run`."""

import signal
import sys

if __name__ == "__main__":
    # While modules are imported, before `main` answers it: Ctrl-C ends the program without a traceback.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    # What processes that launchers start have to import must not lie in __main__.
    from frictionzoo.cli.run import main

    sys.exit(main())
