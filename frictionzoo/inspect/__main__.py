"""`python -m frictionzoo.inspect`, see `frictionzoo.cli.inspect`."""

import sys

from frictionzoo.cli.inspect import main

sys.exit(main())
