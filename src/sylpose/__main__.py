"""Entry point of `python -m sylpose`, the same as the command `sylpose`."""

import sys

from sylpose.commands.main import main

sys.exit(main())
