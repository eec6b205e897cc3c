"""`python -m lemniscate`."""

import sys

from lemniscate.cli import main

sys.exit(main())
