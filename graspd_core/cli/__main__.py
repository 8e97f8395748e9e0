"""Run the command line for `python -m graspd_core.cli`."""

import sys

from graspd_core.cli import main

sys.exit(main())
