"""`python -m lemniscate.cli`."""

import sys

from lemniscate.cli import main

sys.exit(main())
