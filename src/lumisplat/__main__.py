"""``python -m lumisplat`` is the ``lumisplat`` command."""

import sys

from lumisplat.cli import main

sys.exit(main())
