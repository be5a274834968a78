"""``python -m mifit``."""

import sys

from mifit.cli import main

sys.exit(main())
