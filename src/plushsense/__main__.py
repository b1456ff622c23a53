"""Run the command line as ``python -m plushsense``."""

import sys

from plushsense.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
