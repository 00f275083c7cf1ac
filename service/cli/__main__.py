"""`python -m service.cli`: the same as the command `sprung`."""

import sys

from service.cli import main

sys.exit(main())
