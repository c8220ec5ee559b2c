"""`python -m frictionzoo.export`, see `frictionzoo.cli.export`."""

import sys

from frictionzoo.cli.export import main

sys.exit(main())
