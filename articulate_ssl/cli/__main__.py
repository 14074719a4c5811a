"""`python -m articulate_ssl.cli` is the same program as the console scripts."""

from __future__ import annotations

import sys

from articulate_ssl.cli import main

if __name__ == "__main__":
    sys.exit(main())
