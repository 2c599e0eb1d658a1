"""`python -m sylpose` is the command `sylpose`."""

import sys

from sylpose.cli import main

sys.exit(main())
