"""As a command."""

import sys

from bench.first_light.run import main

sys.exit(main())
