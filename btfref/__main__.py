"""``python -m btfref``: the command line."""

import sys

from btfref.cli import main

sys.exit(main())
