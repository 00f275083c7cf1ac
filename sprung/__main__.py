"""`python -m sprung`: the same as the command `sprung`."""

import sys

from sprung.service.cli import main

sys.exit(main())
