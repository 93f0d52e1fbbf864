"""`python -m cmrl_jax`: the command line."""

import sys

from cmrl_jax.cli.main import main

sys.exit(main())
