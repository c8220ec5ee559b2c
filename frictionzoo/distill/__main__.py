"""`python -m frictionzoo.distill`, see `frictionzoo.cli.distill`."""

import sys

from frictionzoo.cli.distill import main

sys.exit(main())
